// pictures_test.cpp - pictures of groups: the image's definition, and derivatives.
// SPDX-License-Identifier: Apache-2.0
#include "pictures.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "fit.hpp"
#include "lod_scenes.hpp"
#include "rgs/math/blend.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/sh.hpp"
#include "views.hpp"

namespace {

using namespace rgs::lod;

constexpr float kCentre[3] = {0, 0, 0};

// A few large Gaussians in a frame of 48 pixels.
Gaussians few(std::uint64_t n, rgs::test::SplitMix& random) {
  rgs::SplatCloud cloud;
  cloud.resize(n, 2);
  for (std::uint64_t i = 0; i < n; ++i) {
    rgs::Splat s;
    for (float& x : s.mean) x = 0.5F * random.dyadic(-1, 1);
    for (float& x : s.log_scale) x = -2.5F + 0.7F * random.dyadic(-1, 1);
    for (float& x : s.rotation) x = random.dyadic(-1, 1) + 0x1p-13F;
    s.opacity_logit = random.dyadic(-1, 2);
    for (float& x : s.sh) x = 0.2F * random.dyadic(-1, 1);
    cloud.set(i, s);
  }
  return activate(cloud.view(), 0, n, kCentre);
}

Frame frame_of(const Axes3& axes) {
  Frame frame;
  frame.axes = axes;
  frame.pixel = 0.06F;
  frame.width = frame.height = 48;
  frame.left = frame.top = -24 * frame.pixel;
  return frame;
}

Picture picture_of(const Gaussians& gaussians, const Frame& frame, const Filter& filter) {
  Projection projection;
  Picture out;
  project(gaussians, frame, filter, projection);
  out.reset(frame.width, frame.height);
  draw(projection.dots, out);
  return out;
}

// Weighted sum over the picture's pixels.
double weighted(const Picture& picture, const Picture& weights) {
  double total = 0;
  for (int y = 0; y < picture.height(); ++y) {
    for (int x = 0; x < picture.width(); ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * picture.stride() + static_cast<std::size_t>(x);
      for (int k = 0; k < 3; ++k)
        total += static_cast<double>(weights.plane(k)[i]) * static_cast<double>(picture.plane(k)[i]);
      total += static_cast<double>(weights.plane(3)[i]) * (1 - static_cast<double>(picture.plane(3)[i]));
    }
  }
  return total;
}

}  // namespace

TEST_CASE("a picture follows the image's definition at a great distance") {
  rgs::test::SplitMix random(1);
  const Gaussians gaussians = few(20, random);
  for (const bool compensated : {false, true}) {
    const Frame frame = frame_of(direction(3, 7));
    const Picture picture = picture_of(gaussians, frame, {0.3F, compensated});
    // The renderer's formulas, pixel by pixel: the camera is so distant that there is no perspective.
    struct One {
      rgs::math::Projected<double> p;
      rgs::math::Vec3<double> color;
    };
    constexpr double kFar = 1e5;
    rgs::math::View<double> view{};
    const float* const rows[3] = {frame.axes.right, frame.axes.down, frame.axes.forward};
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) view.rotation[3 * r + c] = static_cast<double>(rows[r][c]);
    }
    std::vector<One> all;
    for (std::size_t i = 0; i < gaussians.size(); ++i) {
      const auto at = [&](int value) { return static_cast<double>(gaussians.of(value)[i]); };
      const auto along = [&](const float* d) {
        return static_cast<double>(d[0]) * at(kMean) + static_cast<double>(d[1]) * at(kMean + 1) +
               static_cast<double>(d[2]) * at(kMean + 2);
      };
      view.fx = view.fy = kFar / static_cast<double>(frame.pixel);
      view.slope_low_x = view.slope_low_y = -1;
      view.slope_high_x = view.slope_high_y = 1;
      const rgs::math::Vec3<double> p{along(rows[0]), along(rows[1]), kFar};
      One one{};
      const auto cov = rgs::math::project_covariance<double>(
          view, {0, 0, kFar}, {at(kRotation), at(kRotation + 1), at(kRotation + 2), at(kRotation + 3)},
          {at(kScale), at(kScale + 1), at(kScale + 2)});
      one.p.footprint = rgs::math::footprint<double>(
          cov, at(kOpacity), 0.3F,
          compensated ? rgs::math::AntiAliasing::mip_splatting : rgs::math::AntiAliasing::classic);
      one.p.mean.u = (p.x - static_cast<double>(frame.left)) / static_cast<double>(frame.pixel);
      one.p.mean.v = (p.y - static_cast<double>(frame.top)) / static_cast<double>(frame.pixel);
      one.p.z = along(rows[2]);
      const rgs::math::Vec3<double> d{static_cast<double>(rows[2][0]), static_cast<double>(rows[2][1]),
                                      static_cast<double>(rows[2][2])};
      one.color = rgs::math::sh_color<double>(2, rgs::math::sh_basis(2, d), [&](int k) {
        return rgs::math::Vec3<double>{at(kSh + 3 * k), at(kSh + 3 * k + 1), at(kSh + 3 * k + 2)};
      });
      all.push_back(one);
    }
    std::sort(all.begin(), all.end(), [](const One& a, const One& b) { return a.p.z < b.p.z; });
    double largest = 0, covered = 0;
    for (int y = 0; y < frame.height; ++y) {
      for (int x = 0; x < frame.width; ++x) {
        double t = 1, c[3] = {0, 0, 0};
        for (const One& one : all) {
          const double power = rgs::math::power(one.p.footprint.conic, x + 0.5 - one.p.mean.u, y + 0.5 - one.p.mean.v);
          const double alpha = std::min(0.99, one.p.footprint.opacity * std::exp(power));
          if (alpha < 1.0 / 255) continue;
          const double w = t * alpha;
          c[0] += w * one.color.x, c[1] += w * one.color.y, c[2] += w * one.color.z;
          t -= w;
        }
        const std::size_t i = static_cast<std::size_t>(y) * picture.stride() + static_cast<std::size_t>(x);
        for (int k = 0; k < 3; ++k)
          largest = std::max(largest, std::abs(c[k] - static_cast<double>(picture.plane(k)[i])));
        largest = std::max(largest, std::abs(t - static_cast<double>(picture.plane(3)[i])));
        covered += 1 - t;
      }
    }
    CHECK(covered > 100);
    CHECK(largest < 6e-3);  // an alpha of 1/255 across the threshold, and FP32
  }
}

TEST_CASE("gradients match finite differences") {
  rgs::test::SplitMix random(3);
  const Gaussians gaussians = few(6, random);
  const Frame frame = frame_of(direction(2, 9));
  // Smooth weights that vanish at the picture's edge.
  Picture weights;
  weights.reset(frame.width, frame.height);
  for (int k = 0; k < 4; ++k) {
    for (int y = 4; y < frame.height - 4; ++y) {
      for (int x = 4; x < frame.width - 4; ++x) {
        weights.plane(k)[static_cast<std::size_t>(y) * weights.stride() + static_cast<std::size_t>(x)] =
            std::sin(0.2F * static_cast<float>(x + k)) * std::cos(0.15F * static_cast<float>(y - k));
      }
    }
  }
  Projection projection;
  Picture scratch;
  project(gaussians, frame, kDrawn, projection);
  REQUIRE(projection.dots.size() == gaussians.size());
  const Picture drawn = picture_of(gaussians, frame, kDrawn);
  std::vector<float> slopes;
  gradients(frame, projection.dots, weights, drawn, scratch, gaussians.padded(), slopes);
  const auto value_of = [&](const Gaussians& g) { return weighted(picture_of(g, frame, kDrawn), weights); };
  double squared = 0, squared_apart = 0;
  for (std::size_t i = 0; i < gaussians.size(); ++i) {
    const auto check = [&](auto gradient, float h, const auto& change) {
      Gaussians more = gaussians, less = gaussians;
      change(more, h);
      change(less, -h);
      const double numeric = (value_of(more) - value_of(less)) / (2 * static_cast<double>(h));
      const double analytic = static_cast<double>(slopes[static_cast<std::size_t>(gradient) * gaussians.padded() + i]);
      INFO("Gaussian ", i, " gradient ", static_cast<int>(gradient));
      // The edge at 1/255 moves with the Gaussian; the gradient ignores it.
      CHECK(std::abs(numeric - analytic) <= 0.12 * std::abs(numeric) + 0.6);
      squared += numeric * numeric;
      squared_apart += (numeric - analytic) * (numeric - analytic);
    };
    for (int k = 0; k < 3; ++k) {
      check(kByColor + k, 0.02F, [&](Gaussians& g, float h) { g.of(kSh + k)[i] += h / 0.28209479F; });
    }
    check(kByLogOpacity, 0.02F, [&](Gaussians& g, float h) { g.of(kOpacity)[i] *= std::exp(h); });
  }
  CHECK(squared > 500);
  CHECK(squared_apart < 0.05 * 0.05 * squared);
}
