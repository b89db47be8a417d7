// projection.hpp - projects one Gaussian from the world onto the image.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/hd.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

template <class T>
struct Projected {
  PixelPoint<T> mean;
  T z;  ///< depth of the mean, the sort key: depth_of() of camera_models.hpp
  Footprint<T> footprint;
};

/// Projects a Gaussian with a mean in the world, unit rotation and standard deviations in world units. Draw it only if
/// footprint.valid: false outside the depth range (the rest is then 0) or without a usable conic.
template <class T>
RGS_HD inline Projected<T> project(const View<T>& view, const Vec3<T>& mean, const Quaternion<T>& rotation,
                                   const Vec3<T>& scale, T opacity, T low_pass, AntiAliasing anti_aliasing) {
  const Vec3<T> p = to_camera(view, mean);
  if (!in_depth_range(view, p.z)) return {};
  return {to_pixel(view, p), p.z,
          footprint(project_covariance(view, p, rotation, scale), opacity, low_pass, anti_aliasing)};
}

}  // namespace rgs::math
