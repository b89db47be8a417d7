// view_volume.cpp - tests boxes against the planes of a view.
// SPDX-License-Identifier: Apache-2.0
//
// A Gaussian with covariance C at camera depth z has an image variance of at most (f/z)^2 n^T C n + low_pass along the
// image's u axis, with n = (1, 0, -slope) in the camera's axes and the slope clamped as in the projection; along v
// likewise. No pixel changes where its alpha is below 1/255, so it reaches at most 3.34 (f/z sqrt(n^T C n) +
// sqrt(low_pass)) pixels from its mean. Times z/f that is a distance from a plane through the eye and an edge of the
// image, moved outwards by the low-pass' share and a pixel. With an extent of three standard deviations t_k along the
// world's axes, sqrt(n^T C n) <= sum |n_k| t_k / 3. The slope lies between the edge's and its clamp, where |n_k| is
// largest at an end.
//
// A mean in a box of half extents h and its extent t share the box: |mean_k - centre_k| + t_k <= h_k. Their joint reach
// along a normal, sum |normal_k| (h_k - t_k) + reach_k t_k, is linear in t, so it is at most sum max(|normal_k|,
// reach_k) h_k.
#include "pages/view_volume.hpp"

#include <algorithm>
#include <cmath>

namespace rgs::pages {
namespace {

// Covers rotations that are orthonormal to 1e-3 and boxes up to 2^-10 smaller than an extent.
constexpr double kSlack = 1.01;
constexpr double kSigmas = 3.34;
constexpr double kRounding = 1e-5;

}  // namespace

ViewVolume::ViewVolume(const math::View<float>& view, float low_pass) {
  if (view.width == 0 || view.model != math::CameraModel::pinhole) return;
  const auto d = [](float value) { return static_cast<double>(value); };
  eye_ = {d(view.position.x) + d(view.position_low.x), d(view.position.y) + d(view.position_low.y),
          d(view.position.z) + d(view.position_low.z)};
  // Beyond the plane: x X + y Y + z Z > distance. `steepest`: z at the other end of the slopes.
  const auto plane = [&](double x, double y, double z, double distance, double factor, double steepest) {
    const auto along = [&](std::size_t axis, double third) {
      return x * d(view.rotation[axis]) + y * d(view.rotation[3 + axis]) + third * d(view.rotation[6 + axis]);
    };
    Plane out{{along(0, z), along(1, z), along(2, z)},
              {},
              -distance,
              kRounding * (std::fabs(x) + std::fabs(y) + std::fabs(z))};
    for (std::size_t k = 0; k < 3; ++k) {
      const double normal = std::fabs(out.normal[k]);
      out.reach[k] = std::max(normal, factor * std::max(normal, std::fabs(along(k, steepest))));
    }
    return out;
  };
  constexpr double kFactor = kSlack * kSigmas / 3;
  const double margin = kSigmas * std::sqrt(d(low_pass)) + 1;
  const double left = (d(view.cx) + margin) / d(view.fx), top = (d(view.cy) + margin) / d(view.fy);
  const double right = (view.width - d(view.cx) + margin) / d(view.fx);
  const double bottom = (view.height - d(view.cy) + margin) / d(view.fy);
  planes_ = {plane(0, 0, -1, -d(view.near_plane), 0, 0),
             plane(0, 0, 1, d(view.far_plane), 0, 0),
             plane(1, 0, -right, 0, kFactor, -d(view.slope_high_x)),
             plane(-1, 0, -left, 0, kFactor, d(view.slope_low_x)),
             plane(0, 1, -bottom, 0, kFactor, -d(view.slope_high_y)),
             plane(0, -1, -top, 0, kFactor, d(view.slope_low_y))};
}

bool ViewVolume::may_show(const Box& box) const {
  std::array<double, 3> center, half;
  double size = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double low = static_cast<double>(box.min[k]) - eye_[k], high = static_cast<double>(box.max[k]) - eye_[k];
    center[k] = 0.5 * (low + high);
    half[k] = 0.5 * (high - low);
    size += std::fabs(center[k]) + half[k];
  }
  for (const Plane& plane : planes_) {
    double distance = plane.offset - plane.rounding * size, most = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      distance += plane.normal[k] * center[k];
      most += plane.reach[k] * half[k];
    }
    if (distance > most) return false;
  }
  return true;
}

}  // namespace rgs::pages
