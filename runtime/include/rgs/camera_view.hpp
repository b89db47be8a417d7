// camera_view.hpp - a camera as the functions of rgs::math take it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "rgs/camera.hpp"
#include "rgs/math/camera_models.hpp"

namespace rgs {

/// The view of a valid camera, for means relative to `origin`. far_plane = 0 means none.
template <class T>
math::View<T> view_of(const Camera& camera, const Origin& origin, T near_plane, T far_plane) {
  double matrix[16], distortion[math::kDistortions];
  std::ranges::copy(row_major(camera.world_to_camera), matrix);
  std::ranges::copy(camera.distortion, distortion);
  const auto view = math::make_view<T>(matrix, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                                       near_plane, far_plane, {origin[0], origin[1], origin[2]});
  return camera.model == CameraModel::pinhole ? view : math::with_model(view, camera.model, distortion);
}

/// Whether the picture of the view of a camera, without an origin, has the point of the world, and the point's depth.
struct SeenPoint {
  bool is_in_picture;
  double depth;
};
inline SeenPoint see(const math::View<double>& view, const glm::dvec3& point_world) {
  const math::Vec3<double> p = math::to_camera(view, {point_world.x, point_world.y, point_world.z});
  const double depth = math::depth_of(view, p);
  if (!math::in_depth_range(view, depth)) return {false, depth};
  math::PixelPoint<double> at{};
  if (view.model == CameraModel::pinhole) {
    at = math::to_pixel(view, p);
  } else if (const auto landing = math::land(view, p); landing.is_drawn) {
    at = landing.at;
  } else {
    return {false, depth};
  }
  const double u = at.u + 0.5, v = at.v + 0.5;
  return {u >= 0 && u < view.width && v >= 0 && v < view.height, depth};
}

}  // namespace rgs
