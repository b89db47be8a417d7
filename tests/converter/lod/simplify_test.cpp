// simplify_test.cpp - simplified groups: their appearance, and whether the stated error holds.
// SPDX-License-Identifier: Apache-2.0
#include "simplify.hpp"

#include <doctest/doctest.h>

#include <cmath>

#include "fit.hpp"
#include "lod_scenes.hpp"
#include "views.hpp"

namespace {

using namespace rgs::lod;

constexpr float kCentre[3] = {0, 0, 0};
constexpr FitOptions kBest{4, 4, 96};

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
  for (const bool best : {false, true}) {
    const Simplified simple = simplify(group, group.size() / 4, best ? kBest : FitOptions{});
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
  const Simplified fast = simplify(group, group.size() / 4, FitOptions{}),
                   best = simplify(group, group.size() / 4, kBest);
  constexpr float kPixel = 0.06F;
  const double squared[] = {seen(group, fast.gaussians, kPixel).squared, seen(group, best.gaussians, kPixel).squared};
  INFO(squared[0], ' ', squared[1], "; ", fast.error, ' ', best.error);
  CHECK(squared[1] < squared[0]);
  CHECK(best.error < fast.error);
}

TEST_CASE("invisible and coincident Gaussians are simplified too") {
  Gaussians group = small_wall(16);
  const auto check = [&](const Gaussians& g) {
    const Simplified simple = simplify(g, g.size() / 4, FitOptions{});
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
