// camera.hpp - a view as the projection needs it, and points through a pinhole's.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <limits>

#include "rgs/hd.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// A view. Camera axes are OpenCV's: x right, y down, z forward. Pixel coordinates have pixel *centres* at the
/// integers, as in the original rasteriser: half a pixel less than image coordinates from the left edge.
template <class T>
struct View {
  T rotation[9];                ///< world to camera, row-major
  Vec3<T> position;             ///< of the camera, relative to the scene's origin
  Vec3<T> position_low;         ///< rounding error of position: position + position_low has twice the digits
  T fx, fy;                     ///< focal lengths, px
  T cx, cy;                     ///< principal point, px from the left and upper edge of the image
  T slope_low_x, slope_high_x;  ///< range of x/z in which the projection is linearised
  T slope_low_y, slope_high_y;  ///< the same for y/z
  T near_plane, far_plane;      ///< draws near_plane < z <= far_plane
  int width, height;            ///< px
  CameraModel model;            ///< what follows is of others than the pinhole: camera_models.hpp
  T distortion[kDistortions];
  T reach;  ///< nothing is drawn beyond: x^2 + y^2 in the plane z = 1 (opencv), angle to the axis (opencv_fisheye)
};

/// Where R p + t is 0, for a row-major 4x4 matrix [R t]: -R^-1 t. Not -R^T t, since a rotation with few digits is not
/// orthonormal, which matters far from the world's origin.
RGS_HD inline Vec3<double> camera_position(const double (&world_to_camera)[16]) {
  const double* m = world_to_camera;
  const Vec3<double> a{m[0], m[1], m[2]}, b{m[4], m[5], m[6]}, c{m[8], m[9], m[10]};
  const Vec3<double> bc = cross(b, c), ca = cross(c, a), ab = cross(a, b);
  const double scale = -1 / dot(a, bc);
  return {scale * (bc.x * m[3] + ca.x * m[7] + ab.x * m[11]), scale * (bc.y * m[3] + ca.y * m[7] + ab.y * m[11]),
          scale * (bc.z * m[3] + ca.z * m[7] + ab.z * m[11])};
}

/// Builds a pinhole's view from a row-major rigid 4x4 matrix, for means relative to `origin` (double: large world
/// coordinates cancel here instead of per Gaussian). far_plane = 0 means none.
template <class T>
RGS_HD inline View<T> make_view(const double (&world_to_camera)[16], int width, int height, double fx, double fy,
                                double cx, double cy, T near_plane, T far_plane,
                                const Vec3<double>& origin = {0, 0, 0}) {
  View<T> v{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v.rotation[3 * i + j] = static_cast<T>(world_to_camera[4 * i + j]);
  }
  Vec3<double> p = camera_position(world_to_camera);
  p = {p.x - origin.x, p.y - origin.y, p.z - origin.z};
  v.position = {static_cast<T>(p.x), static_cast<T>(p.y), static_cast<T>(p.z)};
  v.position_low = {static_cast<T>(p.x - static_cast<double>(v.position.x)),
                    static_cast<T>(p.y - static_cast<double>(v.position.y)),
                    static_cast<T>(p.z - static_cast<double>(v.position.z))};
  v.fx = static_cast<T>(fx), v.fy = static_cast<T>(fy);
  v.cx = static_cast<T>(cx), v.cy = static_cast<T>(cy);
  // The original clamps to +-1.3 tan(fov/2), which is the image's edge plus 0.3 half images. In this form it also holds
  // for a principal point off the centre.
  const double margin_x = (kFovClamp - 1.0) * 0.5 * width / fx, margin_y = (kFovClamp - 1.0) * 0.5 * height / fy;
  v.slope_low_x = static_cast<T>(-cx / fx - margin_x), v.slope_high_x = static_cast<T>((width - cx) / fx + margin_x);
  v.slope_low_y = static_cast<T>(-cy / fy - margin_y), v.slope_high_y = static_cast<T>((height - cy) / fy + margin_y);
  v.near_plane = near_plane;
  v.far_plane = far_plane > 0 ? far_plane : std::numeric_limits<T>::infinity();
  v.width = width, v.height = height;
  return v;
}

/// From the camera to a point of the scene, in the world's axes. If both are far from the origin and near each other
/// the first difference is exact (Sterbenz), so the error is relative to the result, not to the coordinates.
template <class T>
RGS_HD inline Vec3<T> from_camera(const View<T>& view, const Vec3<T>& p) {
  const Vec3<T>&high = view.position, &low = view.position_low;
  return {p.x - high.x - low.x, p.y - high.y - low.y, p.z - high.z - low.z};
}

/// Camera coordinates of a point of the scene.
template <class T>
RGS_HD inline Vec3<T> to_camera(const View<T>& view, const Vec3<T>& p) {
  const T* r = view.rotation;
  const Vec3<T> d = from_camera(view, p);
  return {r[0] * d.x + r[1] * d.y + r[2] * d.z, r[3] * d.x + r[4] * d.y + r[5] * d.z,
          r[6] * d.x + r[7] * d.y + r[8] * d.z};
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

/// Projects a camera point. The original's ((ndc + 1) * size - 1) / 2 equals f * x / z + size / 2 - 1/2 for a centred
/// principal point.
template <class T>
RGS_HD inline PixelPoint<T> to_pixel(const View<T>& view, const Vec3<T>& p) {
  return {view.fx * p.x / p.z + view.cx - T(0.5), view.fy * p.y / p.z + view.cy - T(0.5)};
}

/// Unit vector from the camera to a point of the scene, the argument of the harmonics; the device's root may be 2 ulp
/// off.
template <class T>
RGS_HD inline Vec3<T> view_direction(const View<T>& view, const Vec3<T>& p) {
  const Vec3<T> d = from_camera(view, p);
#if defined(__CUDA_ARCH__)
  const T inverse_length = ::rsqrt(dot(d, d));
#else
  const T inverse_length = T(1) / std::sqrt(dot(d, d));
#endif
  return {d.x * inverse_length, d.y * inverse_length, d.z * inverse_length};
}

}  // namespace rgs::math
