// splat_edit_test.cpp - moving, turning, mirroring, merging, filtering and stripping, checked by the resulting colours,
// shapes and positions.
// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <glm/geometric.hpp>
#include <glm/matrix.hpp>
#include <limits>

#include "complexity.hpp"
#include "interchange_samples.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/splat_edit.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

glm::dmat3 covariance(const Splat& s) {
  const glm::dmat3 r =
      rotation_from_quaternion({static_cast<double>(s.rotation[0]), static_cast<double>(s.rotation[1]),
                                static_cast<double>(s.rotation[2]), static_cast<double>(s.rotation[3])});
  glm::dmat3 scale(0.0);
  for (int k = 0; k < 3; ++k) scale[k][k] = std::exp(2 * static_cast<double>(s.log_scale[k]));
  return r * scale * glm::transpose(r);
}

double colour(const Splat& s, int degree, const glm::dvec3& d, int channel) {
  const auto basis = math::sh_basis(degree, math::Vec3<double>{d.x, d.y, d.z});
  double sum = 0;
  for (int k = 0; k < sh_coefficients(degree); ++k) sum += basis.y[k] * static_cast<double>(s.sh[3 * k + channel]);
  return sum;
}

// `after` is `before` under x -> scale * m x + shift: positions, shapes, and colours from turned directions.
void check_moved(const SplatCloud& before, const SplatCloud& after, const glm::dmat3& m, double scale,
                 const glm::dvec3& shift) {
  REQUIRE(before.size() == after.size());
  SplitMix random(77);
  for (std::uint64_t i = 0; i < before.size(); ++i) {
    const Splat a = before.view().splat(i), b = after.view().splat(i);
    const glm::dvec3 place = m * glm::dvec3(a.mean[0], a.mean[1], a.mean[2]) * scale + shift;
    const glm::dmat3 expected = scale * scale * (m * covariance(a) * glm::transpose(m)), found = covariance(b);
    double largest = 0;
    for (int j = 0; j < 9; ++j) largest = std::max(largest, std::abs(expected[j / 3][j % 3]));
    for (int k = 0; k < 3; ++k) {
      CHECK(static_cast<double>(b.mean[k]) == doctest::Approx(place[k]).epsilon(1e-5));
      for (int j = 0; j < 3; ++j) CHECK(std::abs(found[k][j] - expected[k][j]) <= 4e-6 * largest);
    }
    const glm::dvec3 d = glm::normalize(glm::dvec3(random.dyadic(-1, 1), random.dyadic(-1, 1), 0.25)), turned = m * d;
    for (int c = 0; c < 3; ++c) {
      CHECK(std::abs(colour(b, after.sh_degree, turned, c) - colour(a, before.sh_degree, d, c)) <= 3e-6);
    }
    CHECK(a.opacity_logit == b.opacity_logit);
  }
}

}  // namespace

TEST_CASE("a scene that does not move keeps its bits, damaged Gaussians included") {
  SplatCloud cloud;
  cloud.resize(1, 0);
  cloud.mean = {std::numeric_limits<float>::quiet_NaN(), 2.5F, -0.0F};
  transform_splats(cloud, Similarity());
  CHECK(std::isnan(cloud.mean[0]));
  CHECK(cloud.mean[1] == 2.5F);
  CHECK(std::signbit(cloud.mean[2]));
}

TEST_CASE("a similarity transforms positions, shapes and view-dependent colours together") {
  SplitMix random(3);
  for (int degree = 0; degree <= 3; ++degree) {
    for (int round = 0; round < 8; ++round) {
      Similarity s;
      s.rotation = round % 2 == 0 ? rotation_from_euler({static_cast<double>(random.dyadic(-180, 180)),
                                                         static_cast<double>(random.dyadic(-180, 180)),
                                                         static_cast<double>(random.dyadic(-180, 180))})
                                  : rotation_from_quaternion({static_cast<double>(random.dyadic(-1, 1)), 0.25,
                                                              static_cast<double>(random.dyadic(-1, 1)),
                                                              static_cast<double>(random.dyadic(-1, 1))});
      s.scale = 0.25 + static_cast<double>(random.dyadic(0, 4));
      s.translation = {1, -2, static_cast<double>(random.dyadic(-9, 9))};
      const SplatCloud before = ordinary_cloud(20, degree, random.bits());
      SplatCloud after = before;
      transform_splats(after, s);
      check_moved(before, after, s.rotation, s.scale, s.translation);
    }
  }
}

TEST_CASE("Euler angles turn about x, then y, then z; composition applies them in turn") {
  const glm::dvec3 turned = rotation_from_euler({90, 90, 0}) * glm::dvec3(0, 1, 0);  // y -> z by x, z -> x by y
  CHECK(glm::distance(turned, glm::dvec3(1, 0, 0)) < 1e-12);
  const Similarity a{rotation_from_euler({10, 20, 30}), 2, {1, 2, 3}},
      b{rotation_from_euler({-40, 50, 60}), 3, {4, 5, 6}};
  SplatCloud one = ordinary_cloud(10, 2, 4), two = one;
  transform_splats(one, a);
  transform_splats(one, b);
  transform_splats(two, compose(b, a));
  const SplatError e = compare(one, two);
  for (const double error : e.mean) CHECK(error <= 1e-4);
  CHECK(e.rotation <= 1e-6);
  for (const double error : e.sh) CHECK(error <= 2e-6);
}

TEST_CASE("twelve steps of a full turn restore the scene") {
  const SplatCloud before = ordinary_cloud(30, 3, 5);
  SplatCloud after = before;
  for (int i = 0; i < 12; ++i) transform_splats(after, {rotation_from_euler({0, 30, 0}), 1, {0, 0, 0}});
  const SplatError e = compare(before, after);
  for (const double error : e.mean) CHECK(error <= 1e-5);
  for (const double error : e.sh) CHECK(error <= 3e-6);
  CHECK(e.rotation <= 2e-6);
}

TEST_CASE("axes: every pair of frames, mirrored ones too, and back exactly") {
  const std::vector<Axes> frames{kAxes3dgs,
                                 kAxesOpenGl,
                                 kAxesGltf,
                                 {Axis::right, Axis::forward, Axis::up},    // z up
                                 {Axis::right, Axis::up, Axis::forward},    // left-handed
                                 {Axis::forward, Axis::left, Axis::down}};  // left-handed
  const auto direction = [](Axis axis) {
    glm::dvec3 d{0, 0, 0};
    const int index = static_cast<int>(axis) - 1;
    const double sign = axis == Axis::right || axis == Axis::up || axis == Axis::forward ? 1 : -1;
    d[index / 2] = sign;
    return d;
  };
  for (const Axes& from : frames) {
    for (const Axes& to : frames) {
      glm::dmat3 m;
      for (std::size_t i = 0; i < 3; ++i) {
        for (std::size_t j = 0; j < 3; ++j)
          m[static_cast<int>(j)][static_cast<int>(i)] = glm::dot(direction(to[i]), direction(from[j]));
      }
      const SplatCloud before = ordinary_cloud(10, 3, 6);
      SplatCloud after = before;
      convert_axes(after, from, to);
      check_moved(before, after, m, 1, {0, 0, 0});
      convert_axes(after, to, from);
      CHECK(after.mean == before.mean);
      CHECK(after.log_scale == before.log_scale);
      CHECK(after.rotation == before.rotation);
      const SplatError e = compare(after, before);
      for (const double error : e.sh) CHECK(error <= 1e-6);
    }
  }
  // Only signs change: harmonics are exact too.
  const SplatCloud before = ordinary_cloud(10, 3, 6);
  SplatCloud after = before;
  convert_axes(after, kAxes3dgs, kAxesOpenGl);
  convert_axes(after, kAxesOpenGl, kAxes3dgs);
  CHECK(after.sh == before.sh);
  convert_axes(after, kAxes3dgs, {Axis::undeclared, Axis::undeclared, Axis::undeclared});
  CHECK(after.mean == before.mean);
}

TEST_CASE("merging keeps everything in order and fills missing harmonics with zero") {
  const SplatCloud a = ordinary_cloud(5, 1, 7), b = ordinary_cloud(4, 3, 8);
  for (const bool swapped : {false, true}) {
    const SplatCloud &first = swapped ? b : a, &second = swapped ? a : b;
    SplatCloud both = first;
    append_splats(both, second);
    REQUIRE(both.view().consistent());
    REQUIRE(both.size() == 9);
    CHECK(both.sh_degree == 3);
    for (std::uint64_t i = 0; i < 9; ++i) {
      const Splat expected = i < first.size() ? first.view().splat(i) : second.view().splat(i - first.size());
      CHECK(std::memcmp(&expected, std::array{both.view().splat(i)}.data(), sizeof(Splat)) == 0);
    }
  }
}

TEST_CASE("stripping harmonics keeps the lower ones") {
  const SplatCloud before = ordinary_cloud(7, 3, 9);
  for (int degree = 0; degree <= 3; ++degree) {
    SplatCloud after = before;
    strip_sh(after, degree);
    REQUIRE(after.view().consistent());
    CHECK(after.sh_degree == degree);
    for (std::uint64_t i = 0; i < 7; ++i) {
      const Splat a = before.view().splat(i), b = after.view().splat(i);
      for (int k = 0; k < 48; ++k) CHECK(b.sh[k] == (k < 3 * sh_coefficients(degree) ? a.sh[k] : 0));
    }
  }
}

TEST_CASE("filters keep the Gaussians named, in order") {
  const SplatCloud before = ordinary_cloud(500, 1, 10);
  SplatFilter crop;
  crop.crop = WorldBox{{-4, -8, 0}, {4, 8, 8}};
  SplatCloud cropped = before;
  filter_splats(cropped, crop);
  std::vector<float> expected;
  for (std::uint64_t i = 0; i < before.size(); ++i) {
    const float* m = &before.mean[3 * i];
    if (m[0] >= -4 && m[0] <= 4 && m[2] >= 0) expected.insert(expected.end(), m, m + 3);
  }
  CHECK(cropped.mean == expected);
  CHECK(cropped.view().consistent());
  CHECK((cropped.size() > 50 && cropped.size() < 250));

  SplatCloud opaque = before;
  opaque.opacity_logit[3] = std::numeric_limits<float>::quiet_NaN();
  filter_splats(opaque, {.crop = {}, .min_opacity = 0.5F});
  for (const float logit : opaque.opacity_logit) CHECK(logit >= 0);
  CHECK(opaque.size() ==
        static_cast<std::uint64_t>(std::ranges::count_if(before.opacity_logit, [](float x) { return x >= 0; })) -
            (before.opacity_logit[3] >= 0 ? 1 : 0));

  const auto weight = [](const Splat& s) {
    float scales[3] = {s.log_scale[0], s.log_scale[1], s.log_scale[2]};
    std::sort(scales, scales + 3);
    return std::log(opacity_from_logit(s.opacity_logit)) + scales[1] + scales[2];
  };
  SplatCloud few = before;
  filter_splats(few, {.crop = {}, .min_opacity = 0, .max_n = 100});
  REQUIRE(few.size() == 100);
  float least = std::numeric_limits<float>::infinity();
  for (std::uint64_t i = 0; i < 100; ++i) least = std::min(least, weight(few.view().splat(i)));
  int heavier = 0;
  for (std::uint64_t i = 0; i < before.size(); ++i) heavier += weight(before.view().splat(i)) > least + 1e-5F ? 1 : 0;
  CHECK(heavier <= 99);
  SplatCloud none = before;
  filter_splats(none, {.crop = {}, .min_opacity = 0, .max_n = 0});
  CHECK(none.size() == 0);
}

TEST_CASE("filters accept infinite logits and scales of 0") {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  SplatCloud cloud = ordinary_cloud(100, 0, 12);
  cloud.opacity_logit[3] = kInfinity;
  cloud.opacity_logit[4] = -kInfinity;
  for (std::size_t k = 0; k < 3; ++k) cloud.log_scale[3 * 3 + k] = 5;  // by far the largest, and flat
  cloud.log_scale[3 * 3 + 1] = -kInfinity;
  SplatCloud most = cloud;
  filter_splats(most, {.crop = {}, .min_opacity = 0, .max_n = 1});
  REQUIRE(most.size() == 1);
  CHECK(most.opacity_logit[0] == kInfinity);
  SplatCloud seen = cloud;
  filter_splats(seen, {.crop = {}, .min_opacity = 1e-6F, .max_n = 100});
  CHECK(std::ranges::count(seen.opacity_logit, kInfinity) == 1);
  CHECK(std::ranges::count(seen.opacity_logit, -kInfinity) == 0);
  SplatCloud moved = cloud;
  transform_splats(moved, {.rotation = rotation_from_euler({10, 20, 30}), .scale = 2, .translation = {1, 2, 3}});
  append_splats(moved, cloud);
  EncodeOptions strict;
  strict.on_bad = BadPolicy::refuse;
  CHECK(clean_splats(moved, strict));
  CHECK(moved.size() == 200);
  CHECK(std::ranges::count(moved.opacity_logit, kInfinity) == 2);
}

TEST_CASE("cleaning applies the damage policies of encode()") {
  SplatCloud cloud = ordinary_cloud(300, 1, 11);
  cloud.mean[3 * 10] = std::numeric_limits<float>::quiet_NaN();
  cloud.rotation[4 * 20 + 1] = std::numeric_limits<float>::infinity();
  EncodeOptions options;
  SplatCloud dropped = cloud;
  const auto scan = clean_splats(dropped, options);
  REQUIRE(scan);
  CHECK(dropped.size() == 298);
  CHECK(scan->defects(Defect::mean) == 1);
  CHECK(dropped.mean[3 * 10] == cloud.mean[3 * 11]);
  options.on_bad = BadPolicy::repair;
  SplatCloud repaired = cloud;
  REQUIRE(clean_splats(repaired, options));
  CHECK(repaired.size() == 299);
  CHECK(repaired.rotation[4 * 19] == 1);
  CHECK(repaired.rotation[4 * 19 + 1] == 0);
  options.on_bad = BadPolicy::refuse;
  CHECK(clean_splats(cloud, options).error().offset == 10);
  options.on_bad = BadPolicy::drop;
  options.max_bad_fraction = 0.001;
  CHECK(clean_splats(cloud, options).error().code == Errc::too_many_bad);
}

TEST_CASE("growth: appending piece by piece is linear in the total size") {
  const SplatCloud piece = ordinary_cloud(1, 0, 1);
  const auto append = [&](std::uint64_t n) {
    SplatCloud all;
    for (std::uint64_t i = 0; i < n; ++i) append_splats(all, piece);
    CHECK(all.size() == n);
  };
  CHECK(growth(
            3000, [](std::uint64_t n) { return n; }, append) < kLinearGrowth);
}

TEST_CASE("appending fills missing harmonics with zeros") {
  SplatCloud all = ordinary_cloud(3, 1, 2);
  const SplatCloud narrow = all, wide = ordinary_cloud(2, 2, 3), none = ordinary_cloud(1, 0, 4);
  append_splats(all, wide);
  append_splats(all, none);
  REQUIRE(all.size() == 6);
  REQUIRE(all.view().consistent());
  CHECK(all.sh_degree == 2);
  for (std::uint64_t i = 0; i < 6; ++i) {
    const Splat s = i < 3 ? narrow.view().splat(i) : i < 5 ? wide.view().splat(i - 3) : none.view().splat(0);
    CHECK(compare(all.view().splat(i), s, 3).sum() == 0);
  }
}
