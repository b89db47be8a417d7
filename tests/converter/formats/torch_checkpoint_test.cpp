// torch_checkpoint_test.cpp - refusals of pickles, hostile files. torch_checkpoint_test.py writes sound checkpoints.
// SPDX-License-Identifier: Apache-2.0
#include "checkout.hpp"
#include "interchange_samples.hpp"
#include "text_file.hpp"
#include "zip_samples.hpp"

using namespace rgs;
using namespace rgs::test;

TEST_CASE("pt: instructions that tensors in dictionaries do not need are refused at their byte") {
  const auto refused = [](const std::string& pickle, Errc code, std::uint64_t offset) {
    Files files;
    files["a/data.pkl"] = bytes_of("\x80\x02" + pickle);
    CAPTURE(pickle);
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    CHECK(file.error().offset == offset);
  };
  refused("}.", Errc::missing_section, 0);  // sound, and no scene
  // Calls of Python, objects, extensions, out-of-band buffers, persistent names, long texts, sets.
  for (const char* op :
       {"cos\nsystem\n.", "ios\nsystem\n.", "o.",    "\x81.", "\x82\1.", "\x92.", "\x93.", "\x95.", "Pa\n.", "\x8c\1a.",
        "\x8f.",          "S'a'\n.",        "I1\n.", "F1\n.", "2.",      "0.",    "1.",    "d.",    "l.",    "\x94."})
    refused(std::string("}") + op, Errc::unsupported_feature, 3);
  refused("ccollections\nOrderedDict\n)R)R.", Errc::unsupported_feature, 30);  // calls what is no function
  refused("ccollections\nOrderedDict\n(K\1tR.", Errc::unsupported_feature, 31);
  refused("ctorch._utils\n_rebuild_tensor_v2\n)R.", Errc::unsupported_feature, 36);
  refused("K\1Q.", Errc::unsupported_feature, 4);
  // Fewer values than an instruction takes, unknown memories, numbers that are cut off.
  for (const char* damaged :
       {"t.", "\x85.", "s.", "u.", "a.", "e.", "b.", "R.", "h\1.", "q\1.", "K", "X\xff\xff\xff\xff.", "c."})
    refused(damaged, Errc::bad_syntax, 2);
  refused("}K\1.", Errc::bad_syntax, 5);
  refused("}(.", Errc::bad_syntax, 4);
  refused("}(K\1u.", Errc::bad_syntax, 6);
  refused("](K\1u.", Errc::bad_syntax, 6);
  refused("}", Errc::truncated, 3);
  refused("}.}", Errc::trailing_bytes, 3);
}

TEST_CASE("pt: damaged checkpoints are refused or read") {
  const std::string folder = source_dir() + "/tests/fuzz/corpus/pt/";
  for (const char* name : {"gsplat.pt", "views.pt"}) {
    const Bytes bytes = bytes_of(read_text(folder + name));
    const auto file = read_splats(bytes);
    REQUIRE(file);
    CHECK(file->format == SplatFormat::pt);
    CHECK(file->cloud.size() == 4);
    check_hostile(bytes, 3, 1000);
  }
}
