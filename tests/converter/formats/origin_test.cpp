// origin_test.cpp - scenes whose coordinates exceed FP32: read relative to an origin, edited, written back.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <glm/vec3.hpp>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "interchange_samples.hpp"
#include "ply_samples.hpp"
#include "rgs/interchange.hpp"
#include "rgs/splat_edit.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

using Position = std::array<double, 3>;
constexpr Position kEcef{4.2e6, 1.7e5, 4.8e6};

// Positions with more digits than FP32, within `size` of `centre` on each axis.
std::vector<Position> positions_around(const Position& centre, double size, std::size_t n) {
  std::mt19937_64 random(7);
  std::uniform_real_distribution<double> place(-size, size);
  std::vector<Position> out(n);
  for (Position& p : out) {
    for (std::size_t k = 0; k < 3; ++k) p[k] = centre[k] + place(random);
  }
  return out;
}

enum class Encoding { ascii, little, big };

// A PLY of degree 0 with coordinates of `type`; with_list: every row also holds a list of three numbers.
std::string ply_of(const std::vector<Position>& positions, const std::string& type = "double",
                   Encoding encoding = Encoding::little, bool with_list = false) {
  const char* const names[] = {"ascii", "binary_little_endian", "binary_big_endian"};
  std::string text = std::string("ply\nformat ") + names[static_cast<int>(encoding)] + " 1.0\nelement vertex " +
                     std::to_string(positions.size()) + "\n";
  if (with_list) text += "property list uchar short odd\n";
  for (const std::string& name : splat_properties(0)) {
    text += "property " + (name.size() == 1 ? type : "float") + " " + name + "\n";
  }
  text += "end_header\n";
  const bool big = encoding == Encoding::big;
  const auto put = [&](auto value) {
    if (encoding != Encoding::ascii) return append_value(text, value, big);
    char digits[64];
    text.append(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
    text += ' ';
  };
  for (const Position& p : positions) {
    if (with_list) {
      if (encoding == Encoding::ascii) {
        text += "3 1 2 3 ";
      } else {
        put(std::uint8_t{3});
        for (int item = 1; item <= 3; ++item) put(static_cast<std::int16_t>(item));
      }
    }
    for (const double x : p) {
      if (type == "double") put(x);
      if (type == "float") put(static_cast<float>(x));
      if (type == "int") put(static_cast<std::int32_t>(x));
    }
    for (const float value : {0.5F, 0.25F, 0.125F, 1.F, -2.F, -3.F, -4.F, 1.F, 0.F, 0.F, 0.F}) put(value);
    if (encoding == Encoding::ascii) text += '\n';
  }
  return text;
}

// Half an ulp of an FP32 number of that size.
double half_ulp(double x) {
  const float size = std::fabs(static_cast<float>(x));
  return 0.5 * static_cast<double>(std::nextafter(size, std::numeric_limits<float>::infinity()) - size);
}

// Every position is origin + mean, to half an ulp of the mean and FP64's rounding.
void check_positions(const SplatCloud& cloud, const Origin& origin, const std::vector<Position>& positions) {
  REQUIRE(cloud.size() == positions.size());
  std::size_t n_off = 0;
  for (std::size_t i = 0; i < positions.size(); ++i) {
    for (std::size_t k = 0; k < 3; ++k) {
      const double mean = cloud.mean[3 * i + k], x = positions[i][k];
      n_off += !(std::fabs(origin[k] + mean - x) <= half_ulp(mean) * 1.001 + std::fabs(x) * 0x1p-52);
    }
  }
  CHECK(n_off == 0);
}

SplatFile read(const std::string& text) {
  auto file = read_splats(std::as_bytes(std::span(text)));
  REQUIRE(file);
  return *std::move(file);
}

}  // namespace

TEST_CASE("double coordinates are read relative to an origin in every encoding, to half an ulp of the means") {
  const auto positions = positions_around(kEcef, 30, 500);
  const SplatFile expected = read(ply_of(positions));
  // 60 units across: multiples of 64.
  CHECK(expected.origin == Origin{4200000, 169984, 4800000});
  check_positions(expected.cloud, expected.origin, positions);
  for (const float x : expected.cloud.mean) CHECK(std::fabs(x) <= 30 + 32);
  for (const Encoding encoding : {Encoding::ascii, Encoding::little, Encoding::big}) {
    for (const bool with_list : {false, true}) {
      CAPTURE(static_cast<int>(encoding));
      CAPTURE(with_list);
      const SplatFile file = read(ply_of(positions, "double", encoding, with_list));
      CHECK(file.origin == expected.origin);
      CHECK(file.cloud.mean == expected.cloud.mean);
      CHECK(file.cloud.log_scale == expected.cloud.log_scale);
      CHECK(file.cloud.sh == expected.cloud.sh);
    }
  }
}

TEST_CASE("an origin is chosen only where FP32 cannot hold the coordinates, and near most of the scene") {
  SUBCASE("floats in doubles, and floats") {
    auto positions = positions_around(kEcef, 30, 50);
    for (Position& p : positions) {
      for (double& x : p) x = static_cast<double>(static_cast<float>(x));
    }
    for (const std::string type : {"double", "float"}) {
      const SplatFile file = read(ply_of(positions, type));
      CHECK(file.origin == kNoOrigin);
      for (std::size_t i = 0; i < 3 * positions.size(); ++i) {
        REQUIRE(static_cast<double>(file.cloud.mean[i]) == positions[i / 3][i % 3]);
      }
    }
  }
  SUBCASE("a scene around the world's origin") {
    const auto positions = positions_around({0.4, -0.3, 0.1}, 5, 200);
    const SplatFile file = read(ply_of(positions));
    CHECK(file.origin == kNoOrigin);
    check_positions(file.cloud, file.origin, positions);
  }
  SUBCASE("floaters and damage do not move it") {
    auto positions = positions_around(kEcef, 30, 500);
    const Origin expected = read(ply_of(positions)).origin;
    positions[3] = {9e9, -9e9, 0.1};
    positions[77] = {1e300, 0, 0};
    positions[9][1] = std::nan("");
    positions[100][2] = HUGE_VAL;
    const SplatFile file = read(ply_of(positions));
    CHECK(file.origin == expected);
    CHECK(std::isnan(file.cloud.mean[3 * 9 + 1]));
    CHECK(std::isinf(file.cloud.mean[3 * 100 + 2]));
  }
  SUBCASE("one spot") {
    const SplatFile file = read(ply_of({{kEcef[0] + 0.1, kEcef[1], kEcef[2] + 0.2}}));
    CHECK(file.origin == Origin{kEcef[0], kEcef[1], kEcef[2]});
    CHECK(file.cloud.mean == std::vector<float>{0.1F, 0, 0.2F});
  }
  SUBCASE("beyond any origin") {
    const SplatFile file = read(ply_of(positions_around({3e12, 0, 0}, 30, 20)));
    CHECK(file.origin == kNoOrigin);
  }
  SUBCASE("integers that FP32 does not hold") {
    const std::vector<Position> positions{{16777217, 1, 2}, {16777219, 3, 4}};
    for (const Encoding encoding : {Encoding::ascii, Encoding::little}) {
      const SplatFile file = read(ply_of(positions, "int", encoding));
      check_positions(file.cloud, file.origin, positions);
      CHECK(file.cloud.mean[0] - file.cloud.mean[3] == -2);
    }
  }
  SUBCASE("nothing") {
    CHECK(read(ply_of({})).origin == kNoOrigin);
  }
}

TEST_CASE("positions read from doubles are written as doubles, twice the same") {
  const auto positions = positions_around(kEcef, 2000, 300);
  const SplatFile file = read(ply_of(positions));
  const auto bytes = encode_splats(file.cloud.view(), SplatFormat::ply, {.origin = file.origin});
  REQUIRE(bytes);
  const std::string text = text_of(*bytes);
  CHECK(text.find("property double x\nproperty double y\nproperty double z\nproperty float nx\n") != text.npos);
  const SplatFile again = read(text);
  CHECK(again.origin == file.origin);
  CHECK(again.cloud.mean == file.cloud.mean);
  CHECK(encode_splats(again.cloud.view(), SplatFormat::ply, {.origin = again.origin}).value() == *bytes);
  // The positions, as any PLY reader gets them.
  const auto ply = PlyFile::open(*bytes);
  REQUIRE(ply);
  CHECK(ply->row_offset(1) - ply->row_offset(0) == ply_row_bytes(0, file.origin));
  for (std::size_t i = 0; i < positions.size(); ++i) {
    Position found;
    std::memcpy(found.data(), bytes->data() + ply->row_offset(i), sizeof found);
    for (std::size_t k = 0; k < 3; ++k) {
      REQUIRE(std::fabs(found[k] - positions[i][k]) <= half_ulp(file.cloud.mean[3 * i + k]) * 1.001 + 1e-9);
    }
  }
  const std::string plain = text_of(encode_splats(file.cloud.view(), SplatFormat::ply).value());
  CHECK(plain.find("double") == plain.npos);
}

TEST_CASE("a PLY is read relative to another file's origin on demand") {
  const auto positions = positions_around(kEcef, 30, 100);
  const std::string wide = ply_of(positions), narrow = ply_of(positions, "float");
  for (const std::string* text : {&wide, &narrow}) {
    auto ply = PlyFile::open(std::as_bytes(std::span(*text)));
    REQUIRE(ply);
    const Origin origin{4.2e6 - 7, 1.7e5 + 0.5, 4.8e6};
    ply->rebase(origin);
    CHECK(ply->origin() == origin);
    const auto splats = read_all(*ply);
    for (std::size_t i = 0; i < positions.size(); ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        const double x = text == &wide ? positions[i][k] : static_cast<double>(static_cast<float>(positions[i][k]));
        REQUIRE(splats[i].mean[k] == static_cast<float>(x - origin[k]));
      }
      REQUIRE(splats[i].sh[0] == 0.5F);
      REQUIRE(splats[i].log_scale[2] == -4.F);
      REQUIRE(splats[i].sh[5] == 0.F);
    }
  }
}

TEST_CASE("a scene with an origin is moved, turned, scaled and mirrored in FP64") {
  const SplatCloud cloud = ordinary_cloud(200, 1, 3);
  const Origin origin{4.2e6 + 0.1, -1.7e5, 4.8e6};
  const Similarity similarity{rotation_from_euler({10, 20, 30}), 0.5, {1000.25, -3, 1e-3}};
  SplatCloud moved = cloud;
  Origin place = origin;
  transform_splats(moved, place, similarity);
  double error = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    glm::dvec3 x, y;
    for (int k = 0; k < 3; ++k) {
      const auto at = 3 * i + static_cast<std::size_t>(k);
      x[k] = origin[static_cast<std::size_t>(k)] + static_cast<double>(cloud.mean[at]);
      y[k] = place[static_cast<std::size_t>(k)] + static_cast<double>(moved.mean[at]);
    }
    const glm::dvec3 d = glm::abs(similarity.rotation * x * similarity.scale + similarity.translation - y);
    error = std::max({error, d.x, d.y, d.z});
  }
  CHECK(error < 1e-6);

  Origin turned = origin;
  convert_axes(turned, kAxes3dgs, kAxesOpenGl);
  CHECK(turned == Origin{origin[0], -origin[1], -origin[2]});
  convert_axes(turned, kAxesOpenGl, kAxes3dgs);
  CHECK(turned == origin);
  convert_axes(turned, {Axis::undeclared, Axis::undeclared, Axis::undeclared}, kAxesOpenGl);
  CHECK(turned == origin);
}

TEST_CASE("a far translation becomes the origin, a near one changes the means") {
  const SplatCloud cloud = ordinary_cloud(200, 0, 4);  // within 8 units, the median 4
  SplatCloud near = cloud, far = cloud, expected = cloud;
  Origin origin = kNoOrigin;
  transform_splats(near, origin, {glm::dmat3(1.0), 1, {100, 0, 0}});
  transform_splats(expected, {glm::dmat3(1.0), 1, {100, 0, 0}});
  CHECK(origin == kNoOrigin);
  CHECK(near.mean == expected.mean);
  transform_splats(far, origin, {glm::dmat3(1.0), 1, {4.2e6, 0, 0.1}});
  CHECK(origin == Origin{4.2e6, 0, 0.1});
  CHECK(far.mean == cloud.mean);
  transform_splats(far, origin, {glm::dmat3(1.0), 1, {-4.2e6, 0, -0.1}});
  CHECK(origin == kNoOrigin);
  CHECK(far.mean == cloud.mean);
}

TEST_CASE("merged scenes get one origin, and the rounding is reported") {
  const SplatCloud a = ordinary_cloud(50, 1, 5), b = ordinary_cloud(60, 1, 6);
  SplatCloud both = a, unmoved;
  append_splats(both, b);
  unmoved = both;
  Origin origin;
  // In the middle, without what is empty; all are multiples of 2^-12.
  std::vector<ScenePart> parts{{50, {4.2e6, 0, 0}}, {0, {1e9, 0, 0}}, {60, {4.2e6 + 16, 0, -8}, 0.5}};
  merge_parts(both, parts, origin);
  CHECK(origin == Origin{4.2e6 + 8, 0, -4});
  CHECK(both.mean[0] == a.mean[0] - 8);
  CHECK(both.mean[3 * 50] == b.mean[0] + 8);
  CHECK(both.mean[3 * 50 + 2] == b.mean[2] - 4);
  CHECK(parts[0].position_rounding == 0);
  CHECK(parts[2].position_rounding == 0.5);
  both = unmoved;
  parts = {{50}, {60, {4.2e6, 0, 0}}};
  merge_parts(both, parts, origin);
  CHECK(origin == Origin{2.1e6, 0, 0});
  for (const ScenePart& part : parts) {
    CHECK(part.position_rounding > 0.05);
    CHECK(part.position_rounding <= 0.125);
  }
  both = unmoved;
  parts = {{50, {1e9, 0, 0}}, {60, {1e9, 0, 0}}};
  merge_parts(both, parts, origin);
  CHECK(origin == Origin{1e9, 0, 0});
  CHECK(both.mean == unmoved.mean);
}

TEST_CASE("a crop takes world coordinates, FP32 or not") {
  const auto positions = positions_around(kEcef, 30, 1000);
  const SplatFile file = read(ply_of(positions));
  const WorldBox box{{kEcef[0] - 10.03, kEcef[1] - 5, kEcef[2] - 20}, {kEcef[0] + 3.01, kEcef[1] + 5, kEcef[2]}};
  SplatCloud cropped = file.cloud;
  filter_splats(cropped, {.crop = box}, file.origin);
  std::vector<float> expected;
  for (std::size_t i = 0; i < file.cloud.size(); ++i) {
    bool inside = true;
    for (std::size_t k = 0; k < 3; ++k) {
      const double x = file.origin[k] + static_cast<double>(file.cloud.mean[3 * i + k]);
      inside = inside && x >= box.min[k] && x <= box.max[k];
    }
    if (inside) expected.insert(expected.end(), &file.cloud.mean[3 * i], &file.cloud.mean[3 * i] + 3);
  }
  REQUIRE(expected.size() > 30);
  CHECK(cropped.mean == expected);
  // Borders are decimals: a mean of 0.1F lies on the border 0.1.
  SplatCloud one = ordinary_cloud(1, 0, 1);
  one.mean = {0.1F, 0, 0};
  filter_splats(one, {.crop = WorldBox{{-1, -1, -1}, {0.1, 1, 1}}});
  CHECK(one.size() == 1);
}

TEST_CASE(".glb: a node's translation is the origin if it is far") {
  const SplatCloud cloud = ordinary_cloud(100, 1, 8);
  const Origin origin{4.2e6 + 0.1, 1.7e5, -4.8e6};
  const auto bytes = encode_splats(cloud.view(), SplatFormat::glb, {.origin = origin});
  REQUIRE(bytes);
  CHECK(text_of(*bytes).find("\"translation\":[4200000.1,170000.0,-4800000.0]") != std::string::npos);
  ReadOptions keep_axes;
  keep_axes.keep_axes = true;
  const auto file = read_splats(*bytes, keep_axes);
  REQUIRE(file);
  CHECK(file->origin == origin);
  CHECK(file->cloud.mean == cloud.mean);
  // In other axes the origin turns with the scene.
  const auto turned = read_splats(*bytes);
  REQUIRE(turned);
  CHECK(turned->origin == Origin{-origin[0], -origin[1], origin[2]});
  CHECK(turned->cloud.mean[0] == -cloud.mean[0]);
}

TEST_CASE("formats without an origin hold FP32 positions, and the rounding is reported") {
  const auto positions = positions_around(kEcef, 30, 400);
  const SplatFile file = read(ply_of(positions));
  const auto rounding = [&](SplatFormat format, const Origin& origin) {
    return position_rounding(file.cloud.view(), format, {.origin = origin}).value();
  };
  for (const SplatFormat format :
       {SplatFormat::rgs, SplatFormat::ply, SplatFormat::glb, SplatFormat::usda, SplatFormat::npz}) {
    CHECK(format_info(format).keeps.origin);
    CHECK(rounding(format, file.origin) == 0);
  }
  for (const SplatFormat format :
       {SplatFormat::splat, SplatFormat::spz, SplatFormat::compressed_ply, SplatFormat::sog}) {
    CAPTURE(format_name(format));
    CHECK_FALSE(keeps_of(format, {}).origin);  // of SPZ's versions only 4 does
    const double largest = rounding(format, file.origin);
    // FP32 has steps of 1/2 at 4.8e6; SPZ's 24 bits have steps of 1.
    CHECK(largest > (format == SplatFormat::spz ? 0.45 : 0.2));
    CHECK(largest <= (format == SplatFormat::spz ? 0.75 : 0.25) + 1e-6);
    if (format == SplatFormat::compressed_ply || format == SplatFormat::sog) continue;  // reordered, and lose more
    const auto bytes = encode_splats(file.cloud.view(), format, {.origin = file.origin});
    REQUIRE(bytes);
    ReadOptions keep_axes;
    keep_axes.keep_axes = true;
    const auto back = read_splats(*bytes, keep_axes);
    REQUIRE(back);
    double found = 0;
    for (std::size_t i = 0; i < back->cloud.mean.size(); ++i) {
      found = std::max(found, std::fabs(static_cast<double>(back->cloud.mean[i]) - file.origin[i % 3] -
                                        static_cast<double>(file.cloud.mean[i])));
    }
    CHECK(found == doctest::Approx(largest));
  }
  CHECK(rounding(SplatFormat::splat, kNoOrigin) == 0);
  CHECK(rounding(SplatFormat::spz, kNoOrigin) <= 0x1p-13);
  CHECK(rounding(SplatFormat::spz, kNoOrigin) > 0x1p-14);
}
