// npz_test.cpp - NumPy's .npz: files of numpy (tests/fuzz/corpus/npz), round trips, every fault of a .npy, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include "checkout.hpp"
#include "interchange_samples.hpp"
#include "zip_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// A .npy of version 1 with this text as its header.
Bytes npy(const std::string& header, std::size_t data_bytes) {
  return bytes_of(std::string("\x93NUMPY\1\0", 8) + static_cast<char>(header.size()) + '\0' + header +
                  std::string(data_bytes, '\0'));
}

std::string header(const std::string& type, const std::string& shape) {
  return "{'descr': '" + type + "', 'fortran_order': False, 'shape': " + shape + ", }\n";
}

// Two Gaussians of degree 1, all zeros.
Files zeros() {
  Files files;
  files["means.npy"] = files["scales.npy"] = npy(header("<f4", "(2, 3)"), 24);
  files["quats.npy"] = npy(header("<f4", "(2, 4)"), 32);
  files["opacities.npy"] = npy(header("<f4", "(2,)"), 8);
  files["sh0.npy"] = npy(header("<f4", "(2, 1, 3)"), 24);
  files["shN.npy"] = npy(header("<f4", "(2, 3, 3)"), 72);
  return files;
}

}  // namespace

TEST_CASE("npz: files of numpy have the values that it wrote, in every type and order") {
  const std::pair<const char*, int> files[] = {{"far_degree0.npz", 0},
                                               {"float32_degree1.npz", 1},
                                               {"float16_fortran_degree2.npz", 2},
                                               {"float64_degree3.npz", 3}};
  for (const auto& [name, sh_degree] : files) {
    const int degree = sh_degree;
    CAPTURE(degree);
    const auto file = read_splats(source_dir() + "/tests/fuzz/corpus/npz/" + name);
    REQUIRE(file);
    CHECK(file->format == SplatFormat::npz);
    REQUIRE(file->cloud.size() == 4);
    REQUIRE(file->cloud.sh_degree == degree);
    const Origin place = degree == 0 ? Origin{500000.5, -4e6 + 0.0625, 100} : kNoOrigin;
    CHECK((file->origin == kNoOrigin) == (degree != 0));
    CHECK(file->position_rounding == 0);
    for (std::uint64_t i = 0; i < 4; ++i) {
      const Splat s = file->cloud.view().splat(i);
      const double n = static_cast<double>(i);
      for (std::size_t c = 0; c < 3; ++c) {
        const double channel = static_cast<double>(c);
        CHECK(file->origin[c] + static_cast<double>(s.mean[c]) == place[c] + n + channel / 4);
        CHECK(static_cast<double>(s.log_scale[c]) == -n / 2 - channel);
        CHECK(static_cast<double>(s.sh[c]) == n / 8 - channel);
        for (int k = 0; k < sh_coefficients(degree) - 1; ++k)
          CHECK(static_cast<double>(s.sh[3 * (k + 1) + static_cast<int>(c)]) == n / 16 + k / 4.0 - channel / 2);
      }
      CHECK(s.rotation[0] == 1);
      CHECK(static_cast<double>(s.rotation[1]) == n / 8);
      CHECK(static_cast<double>(s.rotation[2]) == n / 16);
      CHECK(static_cast<double>(s.rotation[3]) == -n / 4);
      CHECK(static_cast<double>(s.opacity_logit) == n / 2 - 1);
    }
  }
}

TEST_CASE("npz: scenes come back exact, with their origin") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const Origin& origin : {kNoOrigin, Origin{450000, 5000000, -30}}) {
      const SplatCloud cloud = ordinary_cloud(300, degree, 4);
      const Bytes bytes = encode_splats(cloud.view(), SplatFormat::npz, {.origin = origin}).value();
      CHECK(detect_format(bytes) == SplatFormat::npz);
      const auto file = read_splats(bytes);
      REQUIRE(file);
      REQUIRE(file->cloud.size() == 300);
      CHECK(file->cloud.sh_degree == degree);
      CHECK((file->origin == kNoOrigin) == (origin == kNoOrigin));
      CHECK(file->cloud.sh == cloud.sh);
      CHECK(file->cloud.rotation == cloud.rotation);
      CHECK(file->cloud.log_scale == cloud.log_scale);
      CHECK(file->cloud.opacity_logit == cloud.opacity_logit);
      for (std::size_t i = 0; i < cloud.mean.size(); ++i)
        CHECK(std::abs(file->origin[i % 3] + static_cast<double>(file->cloud.mean[i]) - origin[i % 3] -
                       static_cast<double>(cloud.mean[i])) <= 1e-6);
    }
  }
  CHECK(read_splats(encode_splats(SplatCloud().view(), SplatFormat::npz).value())->cloud.size() == 0);
}

TEST_CASE("npz: every fault of an array is an error at its byte") {
  CHECK(read_splats(zipped(zeros())));
  const auto refused = [](const std::string& name, const Bytes& array, Errc code, std::uint64_t offset) {
    CAPTURE(name);
    CAPTURE(text_of(array));
    Files files = zeros();
    files[name] = array;
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(code));
    CHECK(file.error().offset == offset);
  };
  const std::string name = "scales.npy", good = header("<f4", "(2, 3)");
  const Bytes array = npy(good, 24);
  const auto with = [&](std::size_t at, char byte) {
    Bytes edited = array;
    edited[at] = static_cast<std::byte>(byte);
    return edited;
  };
  refused(name, with(1, 'n'), Errc::bad_magic, 0);
  refused(name, with(6, 0), Errc::unsupported_version, 6);
  refused(name, with(6, 4), Errc::unsupported_version, 6);
  refused(name, with(7, 1), Errc::unsupported_version, 6);
  refused(name, with(9, 1), Errc::truncated, 8);
  refused(name, Bytes(array.begin(), array.begin() + 11), Errc::truncated, 11);
  refused(name, npy(good, 23), Errc::size_mismatch, 10 + good.size());
  refused(name, npy(good, 25), Errc::size_mismatch, 10 + good.size());
  for (const char* type : {">f4", "<i4", "|O", "<c8", "<f16", "f4", ""})
    refused(name, npy(header(type, "(2, 3)"), 24), Errc::unsupported_feature, 20);
  refused(name, npy("{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (6,), }", 24),
          Errc::unsupported_feature, 20);
  const std::pair<std::string, std::uint64_t> texts[] = {
      {"", 10},
      {"['descr']", 10},
      {"{'descr': '<f4', }", 28},
      {"{'descr': '<f4', 'descr': '<f4', }", 36},
      {"{'descr': '<f4', 'colour': 1, }", 37},
      {"{'descr': '<f4', 'fortran_order': 0, }", 44},
      {"{'descr': '<f4', 'fortran_order': False, 'shape': 6, }", 60},
      {"{'descr': '<f4', 'fortran_order': False, 'shape': (6), }", 62},
      {"{'descr': '<f4', 'fortran_order': False, 'shape': (-6,), }", 61},
      {"{'descr': '<f4', 'fortran_order': False, 'shape': (6,), } x", 68},
      {"{'descr': '<f4' 'fortran_order': False, 'shape': (6,), }", 26}};
  for (const auto& [text, offset] : texts) refused(name, npy(text, 24), Errc::bad_syntax, offset);
  refused(name, npy(header("<f4", "()"), 4), Errc::unsupported_feature, 10 + header("<f4", "()").size() - 1);
  refused(name, npy(header("<f4", "(1, 1, 2, 3)"), 24), Errc::unsupported_feature,
          10 + header("<f4", "(1, 1, 2, 3)").size() - 1);
  for (const char* shape : {"(9007199254740993, 3)", "(99999999999999999999999, 3)"})
    refused(name, npy(header("<f4", shape), 24), Errc::bad_syntax, 10 + 51 + 16);
  for (const char* shape : {"(9007199254740992, 9007199254740992, 9007199254740992)", "(3, 3)"})
    refused(name, npy(header("<f4", shape), 24), Errc::size_mismatch, 10 + header("<f4", shape).size());
  // Shapes that are sound and not these arrays'.
  refused(name, npy(header("<f4", "(3, 3)"), 36), Errc::bad_header, 0);
  refused(name, npy(header("<f4", "(2, 4)"), 32), Errc::bad_header, 0);
  refused("means.npy", npy(header("<f4", "(6,)"), 24), Errc::bad_header, 0);
  refused("quats.npy", npy(header("<f4", "(2, 3)"), 24), Errc::bad_header, 0);
  refused("opacities.npy", npy(header("<f4", "(2, 2)"), 16), Errc::bad_header, 0);
  refused("sh0.npy", npy(header("<f4", "(2, 2, 3)"), 48), Errc::bad_header, 0);
  refused("shN.npy", npy(header("<f4", "(2, 4, 3)"), 96), Errc::bad_header, 0);
  refused("shN.npy", npy(header("<f4", "(6, 3)"), 72), Errc::bad_header, 0);
  for (const char* array_name : {"means.npy", "scales.npy", "quats.npy", "opacities.npy", "sh0.npy"}) {
    Files files = zeros();
    files.erase(array_name);
    const auto file = read_splats(zipped(files));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == Errc::missing_section);
  }
}

TEST_CASE("npz: two arrays of one name are refused, since readers differ in which they take") {
  Files files = zeros();
  files["neans.npy"] = files["means.npy"];
  Bytes bytes = zipped(files);
  std::string text(text_of(bytes));
  for (std::size_t at = 0; (at = text.find("neans.npy", at)) != text.npos;) text[at] = 'm';
  CHECK(read_splats(bytes_of(text)).error().code == Errc::bad_header);
}

TEST_CASE("npz: damaged files are refused or read, and none unfolds beyond the limit") {
  check_hostile(encode_splats(ordinary_cloud(3, 1, 3).view(), SplatFormat::npz).value(), 1);
  check_hostile(zipped(zeros()), 2);
  Files files = zeros();
  const std::uint64_t n = 100000;
  const std::string shape = std::to_string(n);
  files["means.npy"] = files["scales.npy"] = npy(header("<f4", "(" + shape + ", 3)"), 12 * n);
  files["quats.npy"] = npy(header("<f4", "(" + shape + ", 4)"), 16 * n);
  files["opacities.npy"] = npy(header("<f4", "(" + shape + ",)"), 4 * n);
  files["sh0.npy"] = npy(header("<f4", "(" + shape + ", 3)"), 12 * n);
  files.erase("shN.npy");
  const Bytes bytes = zipped(files);
  ReadOptions options;
  CHECK(read_splats(bytes, options));
  options.limits.max_expansion = 16;
  CHECK(read_splats(bytes, options).error().code == Errc::limit_exceeded);
}
