// view_volume.cpp - tests boxes against the planes of a view.
// SPDX-License-Identifier: Apache-2.0
//
// A Gaussian of largest standard deviation s at camera depth z has an image covariance of at most (f/z)^2 (1 + slope^2)
// s^2 + low_pass along an axis, where the slope is clamped as in the projection. No pixel changes where its alpha is
// below 1/255, so it reaches at most 3.34 (f/z sqrt(1 + slope^2) s + sqrt(low_pass)) pixels from its mean. Times z/f
// that is a distance from a plane through the eye and an edge of the image, moved outwards by the low-pass' share and a
// pixel. An extent of three standard deviations t_k along the axes has s <= |t| / 3, since the largest eigenvalue is at
// most the trace.
//
// A mean in a box of half extents h and its extent t share the box: |mean_k - centre_k| + t_k <= h_k. Their joint reach
// along a normal n, sum |n_k| (h_k - t_k) + reach |t|, is convex in t, so its maximum is at a corner of 0 <= t <= h.
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
  if (view.width == 0) return;
  const auto d = [](float value) { return static_cast<double>(value); };
  eye_ = {d(view.position.x) + d(view.position_low.x), d(view.position.y) + d(view.position_low.y),
          d(view.position.z) + d(view.position_low.z)};
  const auto plane = [&](double x, double y, double z, double distance, double reach) {
    const auto along = [&](int axis) {
      return x * d(view.rotation[axis]) + y * d(view.rotation[3 + axis]) + z * d(view.rotation[6 + axis]);
    };
    return Plane{{along(0), along(1), along(2)},
                 -distance,
                 kSlack * reach / 3,
                 kRounding * (std::fabs(x) + std::fabs(y) + std::fabs(z))};
  };
  const auto reach = [&](float low, float high) {
    const double slope = std::max(std::fabs(d(low)), std::fabs(d(high)));
    return kSigmas * std::sqrt(1 + slope * slope);
  };
  const double reach_x = reach(view.slope_low_x, view.slope_high_x),
               reach_y = reach(view.slope_low_y, view.slope_high_y);
  const double margin = kSigmas * std::sqrt(d(low_pass)) + 1;
  const double left = (d(view.cx) + margin) / d(view.fx), top = (d(view.cy) + margin) / d(view.fy);
  const double right = (view.width - d(view.cx) + margin) / d(view.fx);
  const double bottom = (view.height - d(view.cy) + margin) / d(view.fy);
  planes_ = {plane(0, 0, -1, -d(view.near_plane), 0), plane(0, 0, 1, d(view.far_plane), 0),
             plane(1, 0, -right, 0, reach_x),         plane(-1, 0, -left, 0, reach_x),
             plane(0, 1, -bottom, 0, reach_y),        plane(0, -1, -top, 0, reach_y)};
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
    double distance = plane.offset;
    std::array<double, 3> extent;
    for (std::size_t k = 0; k < 3; ++k) {
      distance += plane.normal[k] * center[k];
      extent[k] = std::fabs(plane.normal[k]) * half[k];
    }
    distance -= plane.rounding * size;
    if (!(distance > extent[0] + extent[1] + extent[2])) continue;
    double most = 0;
    for (unsigned corner = 1; corner < 8; ++corner) {
      double means = 0, squared = 0;
      for (std::size_t k = 0; k < 3; ++k) {
        if ((corner >> k & 1) != 0) {
          squared += half[k] * half[k];
        } else {
          means += extent[k];
        }
      }
      most = std::max(most, means + plane.reach * std::sqrt(squared));
    }
    if (distance > most) return false;
  }
  return true;
}

}  // namespace rgs::pages
