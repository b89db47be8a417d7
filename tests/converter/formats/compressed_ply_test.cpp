// compressed_ply_test.cpp - compressed PLY: another tool's file, round trips, older and gsplat's variants, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <cstring>
#include <limits>

#include "complexity.hpp"
#include "interchange_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// Steps of one chunk's codes. Decoded values span the stored bounds; rounding to floats adds a few units in the last
// place, which is all the error of a chunk of one Gaussian.
SplatError steps_of(const SplatCloud& copy, std::uint64_t first, std::uint64_t end) {
  double low[9], high[9];
  std::fill_n(low, 9, std::numeric_limits<double>::infinity());
  std::fill_n(high, 9, -std::numeric_limits<double>::infinity());
  for (std::uint64_t i = first; i < end; ++i) {
    const Splat s = copy.view().splat(i);
    for (int k = 0; k < 9; ++k) {
      const double value = static_cast<double>(k < 3 ? s.mean[k] : k < 6 ? s.log_scale[k - 3] : s.sh[k - 6]);
      low[k] = std::min(low[k], value);
      high[k] = std::max(high[k], value);
    }
  }
  SplatError step;
  const auto step_of = [&](int k, double codes) {
    return (high[k] - low[k]) / codes + 1e-6 * std::max({std::abs(low[k]), std::abs(high[k]), 0.5});
  };
  for (int k = 0; k < 3; ++k) {
    step.mean[k] = step_of(k, k == 1 ? 1023 : 2047);
    step.log_scale[k] = step_of(3 + k, k == 1 ? 1023 : 2047);
    step.sh[0] = std::max(step.sh[0], step_of(6 + k, 255));
  }
  step.opacity = 1.0 / 255;
  step.rotation = 3 * 2 * 0.70711 / 1023;  // three codes make the fourth component
  step.sh[1] = step.sh[2] = step.sh[3] = 1.0 / 32;
  return step;
}

// Every Gaussian of `copy` is within half a step of its original, in the same order or found by search.
void check_half_a_step(const SplatCloud& copy, const SplatCloud& original, bool same_order) {
  REQUIRE(copy.size() == original.size());
  REQUIRE(copy.sh_degree == original.sh_degree);
  Matcher matcher(original);
  double worst = 0;
  for (std::uint64_t first = 0; first < copy.size(); first += 256) {
    const std::uint64_t end = std::min(copy.size(), first + 256);
    const SplatError step = steps_of(copy, first, end);
    for (std::uint64_t i = first; i < end; ++i) {
      const std::uint64_t partner = same_order ? i : matcher.nearest(copy.view().splat(i), step);
      worst = std::max(worst, compare(copy.view().splat(i), original.view().splat(partner), copy.sh_degree).over(step));
    }
  }
  CHECK(worst <= 0.502);
  if (!same_order) CHECK(matcher.n_found() >= original.size() - original.size() / 100);  // some are nearly equal
}

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  REQUIRE(at != text.npos);
  return text.replace(at, from.size(), to);
}

}  // namespace

TEST_CASE("a compressed PLY by another tool holds the PLY's Gaussians within the format's steps") {
  if (!has_peer_files()) return;
  const SplatCloud original = read_splats(peer_file("crop.ply")).value().cloud;
  const auto file = read_splats(peer_file("crop.compressed.ply"));
  REQUIRE(file);
  CHECK(file->format == SplatFormat::compressed_ply);
  check_half_a_step(file->cloud, original, false);
}

TEST_CASE("compressed PLY round trip within half a step of each chunk") {
  for (int degree = 0; degree <= 3; ++degree) {
    for (const std::uint64_t n : {0U, 1U, 255U, 256U, 257U, 1000U}) {
      CAPTURE(degree);
      CAPTURE(n);
      const SplatCloud cloud = ordinary_cloud(n, degree, n + 3);
      const auto bytes = encode_splats(cloud.view(), SplatFormat::compressed_ply, {.keep_order = true});
      REQUIRE(bytes);
      const auto file = read_splats(*bytes);
      REQUIRE(file);
      CHECK(file->format == SplatFormat::compressed_ply);
      check_half_a_step(file->cloud, cloud, true);
      const auto sorted = encode_splats(cloud.view(), SplatFormat::compressed_ply);
      REQUIRE(sorted);
      CHECK(sorted->size() == bytes->size());
      check_half_a_step(read_splats(*sorted).value().cloud, cloud, false);
    }
  }
}

TEST_CASE("compressed PLY without chunk colours, as older tools wrote it, and with properties in another order") {
  const SplatCloud cloud = ordinary_cloud(100, 1, 9);
  const std::string text =
      text_of(encode_splats(cloud.view(), SplatFormat::compressed_ply, {.keep_order = true}).value());
  const std::size_t data = text.find("end_header\n") + 11;
  // Without the bounds 0..1 the codes are the colour itself.
  std::string header = text.substr(0, data);
  for (const char* name : {"min_r", "min_g", "min_b", "max_r", "max_g", "max_b"}) {
    header = replaced(header, std::string("property float ") + name + "\n", "");
  }
  const auto old = read_splats(bytes_of(header + text.substr(data, 48) + text.substr(data + 72)));
  REQUIRE(old);
  const SplatCloud now = read_splats(bytes_of(text)).value().cloud;
  CHECK(old->cloud.mean == now.mean);
  CHECK(old->cloud.rotation == now.rotation);
  float red[2];
  std::memcpy(&red[0], &text[data + 48], 4);
  std::memcpy(&red[1], &text[data + 60], 4);
  const double code = (0.5 + 0.28209479 * static_cast<double>(now.sh[0]) - static_cast<double>(red[0])) /
                      static_cast<double>(red[1] - red[0]);
  CHECK(0.5 + 0.28209479 * static_cast<double>(old->cloud.sh[0]) == doctest::Approx(code).epsilon(1e-5));

  // Swapping two names swaps the axes.
  std::string swapped = replaced(text, "f_rest_0\n", "f_rest_X\n");
  swapped = replaced(swapped, "f_rest_1\n", "f_rest_0\n");
  swapped = replaced(swapped, "f_rest_X\n", "f_rest_1\n");
  const auto other = read_splats(bytes_of(swapped));
  REQUIRE(other);
  CHECK(other->cloud.sh[3] == now.sh[6]);
  CHECK(other->cloud.sh[6] == now.sh[3]);
}

TEST_CASE("plain PLY as gsplat writes it: no normals, no harmonics, extra columns") {
  for (const bool extra : {false, true}) {
    std::string text = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n";
    for (const char* name : {"x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
                             "rot_0", "rot_1", "rot_2", "rot_3"}) {
      text += std::string("property float ") + name + "\n";
    }
    if (extra) text += "property float filter_3D\nproperty uchar red\n";
    text += "end_header\n";
    for (int i = 1; i <= 14; ++i) {
      const auto value = static_cast<float>(i);
      text.append(reinterpret_cast<const char*>(&value), 4);
    }
    if (extra) text.append(5, '\0');
    const auto file = read_splats(bytes_of(text));
    REQUIRE(file);
    CHECK(file->format == SplatFormat::ply);
    CHECK(file->cloud.mean == std::vector<float>{1, 2, 3});
    CHECK(file->cloud.sh == std::vector<float>{4, 5, 6});
    CHECK(file->cloud.opacity_logit == std::vector<float>{7});
    CHECK(file->cloud.rotation == std::vector<float>{11, 12, 13, 14});
  }
}

TEST_CASE("damaged compressed PLY files are refused or read, but never crash") {
  const SplatCloud cloud = ordinary_cloud(3, 1, 5);
  const Bytes bytes = encode_splats(cloud.view(), SplatFormat::compressed_ply).value();
  check_hostile(bytes, 3);
  const std::string text = text_of(bytes);
  const auto refused = [&](const std::string& from, const std::string& to, Errc code) {
    CAPTURE(from);
    CAPTURE(to);
    const auto file = read_splats(bytes_of(replaced(text, from, to)));
    REQUIRE_FALSE(file);
    CHECK(file.error().code == code);
  };
  refused("vertex 3", "vertex 18446744073709551615", Errc::truncated);
  refused("vertex 3", "vertex 0", Errc::bad_header);
  refused("end_header", "element more 1\nproperty int a\nend_header", Errc::truncated);
  const auto longer = read_splats(bytes_of(text + "x"));
  REQUIRE_FALSE(longer);
  CHECK(longer.error().code == Errc::trailing_bytes);
  CHECK(longer.error().offset == text.size());
  refused("chunk 1", "chunk 4611686018427387904", Errc::truncated);
  refused("chunk 1", "chunk 0", Errc::bad_header);
  refused("sh 3", "sh 2", Errc::bad_header);
  refused("uint packed_scale", "uint packed_other", Errc::bad_header);
  refused("uint packed_scale", "int packed_scale", Errc::bad_header);
  refused("float min_y", "float min_q", Errc::bad_header);
  refused("uchar f_rest_8", "uchar f_rest_9", Errc::unsupported_feature);
  refused("binary_little_endian", "binary_big_endian", Errc::unsupported_feature);
  refused("uchar f_rest_0", "list uchar int f_rest_0", Errc::unsupported_feature);
  // Counts that agree with each other but not with the file.
  const std::string fewer = replaced(replaced(text, "vertex 3", "vertex 2"), "sh 3", "sh 2");
  const auto file = read_splats(bytes_of(fewer));
  REQUIRE_FALSE(file);
  CHECK(file.error().code == Errc::trailing_bytes);
  CHECK(file.error().offset == fewer.size() - 16 - 9);
}

TEST_CASE("growth: compressed PLY is written in linear time wherever the Gaussians are") {
  const auto write = [](const SplatCloud& cloud) { CHECK(encode_splats(cloud.view(), SplatFormat::compressed_ply)); };
  const auto placed = [](const auto& place) {
    return [place](std::uint64_t n) {
      SplatCloud cloud = ordinary_cloud(n, 0, 7);
      for (std::uint64_t i = 0; i < n; ++i) {
        for (std::uint64_t k = 0; k < 3; ++k) cloud.mean[3 * i + k] = place(i, k, n);
      }
      return cloud;
    };
  };
  const float huge = std::numeric_limits<float>::max();
  CHECK(growth(2000, placed([](auto...) { return 1.F; }), write) < kLinearGrowth);
  CHECK(growth(2000,
               placed([=](std::uint64_t i, std::uint64_t k, auto) { return k == 0 && i % 2 == 0 ? huge : -huge; }),
               write) < kLinearGrowth);
  // Distances grow exponentially.
  CHECK(growth(2000, placed([](std::uint64_t i, std::uint64_t k, std::uint64_t n) {
                 const auto share = static_cast<double>(i) / static_cast<double>(n);
                 return k == 0 ? static_cast<float>(std::exp2(250 * share - 125)) : 0.F;
               }),
               write) < kLinearGrowth);
}

TEST_CASE("compressed PLY of coincident Gaussians keeps their order") {
  SplatCloud cloud = ordinary_cloud(2000, 0, 7);
  std::ranges::fill(cloud.mean, 2.F);
  CHECK(encode_splats(cloud.view(), SplatFormat::compressed_ply).value() ==
        encode_splats(cloud.view(), SplatFormat::compressed_ply, {.keep_order = true}).value());
}
