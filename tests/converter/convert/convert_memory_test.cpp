// convert_memory_test.cpp - a conversion's memory beside the mapped input.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include "convert.hpp"
#include "convert_scenes.hpp"
#include "counted_memory.hpp"
#include "rgs/decode.hpp"
#include "rgs/file.hpp"
#include "rgs/ply.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

TEST_CASE("a conversion on two threads holds at most 16 MB + 48 bytes per Gaussian") {
  if (!counts_memory()) return skip("a sanitizer replaces the allocator");
  constexpr std::uint64_t kN = 400'000;  // the rows alone would take 94 MB
  // The documented limit is 64 MB beside the input; the program and its stacks take the rest.
  constexpr std::int64_t kMost = 16'000'000 + 48 * static_cast<std::int64_t>(kN);
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), golden_cloud(kN, 3, 77));
  const tbb::global_control two(tbb::global_control::max_allowed_parallelism, 2);
  const auto holds = [](auto&& convert) {
    const std::int64_t before = live_bytes();
    reset_peak_bytes();
    REQUIRE(convert());
    return peak_bytes() - before;
  };
  for (const bool keep_permutation : {false, true}) {
    CAPTURE(keep_permutation);
    const std::string rgs = folder.file(keep_permutation ? "kept.rgs" : "scene.rgs");
    const std::int64_t to_rgs = holds([&] {
      const auto file = MappedFile::open(ply);
      REQUIRE(file);
      const auto source = PlyFile::open(file->bytes());
      REQUIRE(source);
      ConvertOptions options;
      options.encode.keep_permutation = keep_permutation;
      options.output.sync = false;
      return convert_to_rgs(*source, rgs, options).has_value();
    });
    CHECK(to_rgs < kMost);
    const std::int64_t to_ply = holds([&] {
      const auto file = MappedFile::open(rgs);
      REQUIRE(file);
      const auto source = FileView::open(file->bytes());
      REQUIRE(source);
      return convert_rgs_to_ply(*source, folder.file("back.ply"), {.overwrite = true, .sync = false}).has_value();
    });
    CHECK(to_ply < kMost);
  }
}
