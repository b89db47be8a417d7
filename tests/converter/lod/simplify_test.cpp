// simplify_test.cpp - simplified groups: their appearance, and whether the stated error holds.
// SPDX-License-Identifier: Apache-2.0
#include "simplify.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "fit.hpp"
#include "lod_scenes.hpp"
#include "measure.hpp"
#include "views.hpp"

namespace {

using namespace rgs::lod;

constexpr float kCentre[3] = {0, 0, 0};

// Squared difference per covered pixel between `drawn` and the supersampled `group` at that pixel size, from 7
// directions that the builder does not use; and the covered share.
struct Seen {
  double squared = 0, covered = 0, of_truth = 0;
};
Seen seen(const Gaussians& group, const Gaussians& drawn, float pixel) {
  Projection projection;
  Picture fine, truth, picture;
  Seen out;
  for (int i = 0; i < 7; ++i) {
    const Frame frame = frame_around(group, direction(i, 7), pixel, 400);
    true_picture(group, frame, 4, projection, fine, truth);
    project(drawn, frame, kDrawn, projection);
    picture.reset(frame.width, frame.height);
    draw(projection.dots, picture);
    const Difference d = difference(truth, picture);
    out.squared += d.squared;
    out.of_truth += d.covered;
    out.covered += difference(picture, truth).covered;
  }
  out.squared /= out.of_truth;
  return out;
}

Gaussians small_wall(std::uint64_t side) {
  rgs::test::SplitMix random(7);
  const rgs::SplatCloud cloud = rgs::test::wall(side, 1, random);
  return activate(cloud.view(), 0, cloud.size(), kCentre);
}

}  // namespace

TEST_CASE("a quarter of a wall's Gaussians looks like the wall from its error on, with its coverage") {
  const Gaussians group = small_wall(64);
  for (const Quality quality : {Quality::fast, Quality::best}) {
    const Simplified simple = simplify(group, group.size() / 4, quality);
    CHECK(simple.gaussians.size() <= group.size() / 4);
    CHECK(simple.error > 0);
    CHECK(simple.error < 0.25F);  // of a wall of 1 x 1
    const Seen whole = seen(group, group, simple.error), fewer = seen(group, simple.gaussians, simple.error);
    INFO("error ", simple.error, " squared ", fewer.squared, " of the group itself ", whole.squared);
    CHECK(fewer.squared <= 1.5 * allowed_squared(whole.squared, 1));  // other directions
    CHECK(fewer.covered == doctest::Approx(fewer.of_truth).epsilon(0.03));
  }
}

TEST_CASE("fitted colours and opacities improve the picture and lower the error") {
  const Gaussians group = small_wall(64);
  const Simplified fast = simplify(group, group.size() / 4), best = simplify(group, group.size() / 4, Quality::best);
  constexpr float kPixel = 0.06F;
  const double squared[] = {seen(group, fast.gaussians, kPixel).squared, seen(group, best.gaussians, kPixel).squared};
  INFO(squared[0], ' ', squared[1], "; ", fast.error, ' ', best.error);
  CHECK(squared[1] < squared[0]);
  CHECK(best.error < fast.error);
}

TEST_CASE("a few large Gaussians before many small ones are merged to what they cover") {
  const Gaussians wall = small_wall(48);
  constexpr std::size_t kLarge = 96;
  Gaussians group(wall.size() + kLarge, wall.sh_degree()), large(kLarge, wall.sh_degree());
  for (int v = 0; v < group.n_values(); ++v) {
    std::copy_n(wall.of(v), wall.size(), group.of(v));
    for (std::size_t i = 0; i < kLarge; ++i) large.of(v)[i] = wall.of(v)[0];
  }
  for (std::size_t i = 0; i < kLarge; ++i) {
    large.of(kMean)[i] = 0.04F * static_cast<float>(i % 12);
    large.of(kMean + 1)[i] = 0.04F * static_cast<float>(i / 12);
    large.of(kMean + 2)[i] = 5;
    for (int k = 0; k < 3; ++k) large.of(kScale + k)[i] = 0.3F;
    large.of(kOpacity)[i] = 0.1F;
  }
  for (int v = 0; v < group.n_values(); ++v) std::copy_n(large.of(v), kLarge, group.of(v) + wall.size());
  const Simplified simple = simplify(group, group.size() / 4);
  std::vector<std::uint32_t> left;
  for (std::uint32_t i = 0; i < simple.gaussians.size(); ++i) {
    if (simple.gaussians.of(kMean + 2)[i] > 4) left.push_back(i);
  }
  Gaussians kept(left.size(), wall.sh_degree());
  for (int v = 0; v < kept.n_values(); ++v) {
    for (std::size_t i = 0; i < left.size(); ++i) kept.of(v)[i] = simple.gaussians.of(v)[left[i]];
  }
  CHECK(left.size() < kLarge);
  const Seen fewer = seen(large, kept, 0.05F);
  INFO(left.size(), " left, squared ", fewer.squared);
  CHECK(fewer.squared < 1e-3);
  CHECK(fewer.covered == doctest::Approx(fewer.of_truth).epsilon(0.02));
}

TEST_CASE("invisible and coincident Gaussians are simplified too") {
  Gaussians group = small_wall(16);
  const auto check = [&](const Gaussians& g) {
    const Simplified simple = simplify(g, g.size() / 4);
    CHECK(simple.gaussians.size() <= g.size() / 4);
    CHECK(simple.gaussians.size() > 0);
    CHECK(std::isfinite(simple.error));
    for (int v = 0; v < simple.gaussians.n_values(); ++v) {
      for (std::size_t i = 0; i < simple.gaussians.size(); ++i) REQUIRE(std::isfinite(simple.gaussians.of(v)[i]));
    }
  };
  Gaussians hidden = group, point = group, flat = group, far = group, huge = group;
  for (std::size_t i = 0; i < group.size(); ++i) {
    hidden.of(kOpacity)[i] = 0;
    for (int k = 0; k < 3; ++k) point.of(kMean + k)[i] = 1;
    for (int k = 0; k < 3; ++k) flat.of(kScale + k)[i] = 0;
    far.of(kMean)[i] *= std::pow(10.F, static_cast<float>(i % 9));
    for (int k = 0; k < 3; ++k) huge.of(kScale + k)[i] *= std::pow(10.F, static_cast<float>(i % 9));
  }
  check(hidden);
  check(point);
  check(flat);
  check(far);
  check(huge);
}

TEST_CASE("pictures too bright to compare do not pass for equal ones") {
  Gaussians group = small_wall(16);
  for (std::size_t i = 0; i < group.size(); ++i) group.of(kSh)[i] = i % 2 == 0 ? 1e25F : -1e25F;
  const float error = simplify(group, group.size() / 4).error;
  CAPTURE(error);
  CHECK_FALSE(error < 1e30F);
}
