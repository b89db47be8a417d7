// camera.hpp - a pinhole view in the form the projection needs, and points through it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <limits>

#include "rgs/hd.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// A view. Camera axes are OpenCV's: x right, y down, z forward. Pixel coordinates here have pixel *centres* at the
/// integers, as the original rasteriser does: half a pixel less than image coordinates measured from the left edge.
template <class T>
struct View {
  T rotation[9];                ///< world to camera, row-major
  T translation[3];             ///< world to camera
  Vec3<T> position;             ///< of the camera, in the world
  T fx, fy;                     ///< focal lengths, px
  T cx, cy;                     ///< principal point, px from the left and upper edge of the image
  T slope_low_x, slope_high_x;  ///< range of x/z in which the projection is linearised
  T slope_low_y, slope_high_y;  ///< the same of y/z
  T near_plane, far_plane;      ///< drawn are near_plane < z <= far_plane
  int width, height;            ///< px
};

/// Builds a view from a row-major rigid 4x4 matrix (double: large world coordinates cancel here and not per Gaussian).
/// far_plane = 0 means none.
template <class T>
RGS_HD inline View<T> make_view(const double (&world_to_camera)[16], int width, int height, double fx, double fy,
                                double cx, double cy, T near_plane, T far_plane) {
  View<T> v{};
  const double* m = world_to_camera;
  double position[3];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v.rotation[3 * i + j] = static_cast<T>(m[4 * i + j]);
    v.translation[i] = static_cast<T>(m[4 * i + 3]);
    position[i] = -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
  }
  v.position = {static_cast<T>(position[0]), static_cast<T>(position[1]), static_cast<T>(position[2])};
  v.fx = static_cast<T>(fx), v.fy = static_cast<T>(fy);
  v.cx = static_cast<T>(cx), v.cy = static_cast<T>(cy);
  // The original clamps to +-1.3 tan(fov/2), which is the image's edge plus 0.3 half images. Written that way it also
  // holds for a principal point beside the centre.
  const double margin_x = (kFovClamp - 1.0) * 0.5 * width / fx, margin_y = (kFovClamp - 1.0) * 0.5 * height / fy;
  v.slope_low_x = static_cast<T>(-cx / fx - margin_x), v.slope_high_x = static_cast<T>((width - cx) / fx + margin_x);
  v.slope_low_y = static_cast<T>(-cy / fy - margin_y), v.slope_high_y = static_cast<T>((height - cy) / fy + margin_y);
  v.near_plane = near_plane;
  v.far_plane = far_plane > 0 ? far_plane : std::numeric_limits<T>::infinity();
  v.width = width, v.height = height;
  return v;
}

/// World point in camera coordinates.
template <class T>
RGS_HD inline Vec3<T> to_camera(const View<T>& view, const Vec3<T>& p) {
  const T* r = view.rotation;
  const T* t = view.translation;
  return {r[0] * p.x + r[1] * p.y + r[2] * p.z + t[0], r[3] * p.x + r[4] * p.y + r[5] * p.z + t[1],
          r[6] * p.x + r[7] * p.y + r[8] * p.z + t[2]};
}

/// Whether a mean at camera depth z is drawn; false for NaN.
template <class T>
RGS_HD inline bool in_depth_range(const View<T>& view, T z) {
  return z > view.near_plane && z <= view.far_plane;
}

template <class T>
struct PixelPoint {
  T u, v;  ///< px, pixel centres at the integers
};

/// Camera point on the image. The original writes ((ndc + 1) * size - 1) / 2, which for a centred principal point is
/// f * x / z + size / 2 - 1/2.
template <class T>
RGS_HD inline PixelPoint<T> to_pixel(const View<T>& view, const Vec3<T>& p) {
  return {view.fx * p.x / p.z + view.cx - T(0.5), view.fy * p.y / p.z + view.cy - T(0.5)};
}

/// Unit vector from the camera to a world point, the argument of the harmonics; the device's root may be 2 ulp off.
template <class T>
RGS_HD inline Vec3<T> view_direction(const View<T>& view, const Vec3<T>& p) {
  const Vec3<T> d{p.x - view.position.x, p.y - view.position.y, p.z - view.position.z};
#if defined(__CUDA_ARCH__)
  const T inverse_length = ::rsqrt(dot(d, d));
#else
  const T inverse_length = T(1) / std::sqrt(dot(d, d));
#endif
  return {d.x * inverse_length, d.y * inverse_length, d.z * inverse_length};
}

}  // namespace rgs::math
