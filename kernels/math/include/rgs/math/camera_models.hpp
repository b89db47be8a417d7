// camera_models.hpp - views other than the pinhole's: lenses, panoramas and parallel rays.
// SPDX-License-Identifier: Apache-2.0
//
// A Gaussian's spread is projected by the Jacobian at its mean, as the pinhole's is: docs/format/RENDERING.md, "Camera
// models", says why.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "rgs/hd.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// A point of the plane z = 1 after OpenCV's distortion, and its derivatives by the point: [xx xy; xy yy].
template <class T>
struct Distorted {
  T x, y;
  T xx, xy, yy;
};

template <class T>
RGS_HD inline Distorted<T> distort(const T (&k)[kDistortions], T x, T y) {
  const T p1 = k[2], p2 = k[3], two = T(2), three = T(3), six = T(6);
  const T r2 = x * x + y * y;
  const T under = T(1) + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
  const T radial = (T(1) + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / under;
  const T slope =
      (k[0] + r2 * (two * k[1] + r2 * three * k[4]) - radial * (k[5] + r2 * (two * k[6] + r2 * three * k[7]))) /
      under;  // of radial, by r2
  return {x * radial + two * p1 * x * y + p2 * (r2 + two * x * x),
          y * radial + p1 * (r2 + two * y * y) + two * p2 * x * y,
          radial + two * x * x * slope + two * p1 * y + six * p2 * x, two * x * y * slope + two * p1 * x + two * p2 * y,
          radial + two * y * y * slope + six * p1 * y + two * p2 * x};
}

/// The radius on the image of a fisheye, in focal lengths, at an angle to the axis; and its derivative.
template <class T>
struct FisheyeRadius {
  T radius, slope;
};
template <class T>
RGS_HD inline FisheyeRadius<T> fisheye_radius(const T (&k)[kDistortions], T angle) {
  const T a = angle * angle;
  return {angle * (T(1) + a * (k[0] + a * (k[1] + a * (k[2] + a * k[3])))),
          T(1) + a * (T(3) * k[0] + a * (T(5) * k[1] + a * (T(7) * k[2] + a * T(9) * k[3])))};
}

namespace detail {

// The largest of 0..`most` up to which `rises`, if it is true at 0; `most` if it is true everywhere.
template <class Rises>
double rises_up_to(double most, const Rises& rises) {
  constexpr int kSteps = 1024;  // a fall and rise between two of them go unnoticed
  int step = 1;
  while (step <= kSteps && rises(most * step / kSteps)) ++step;
  if (step > kSteps) return most;
  double low = most * (step - 1) / kSteps, high = most * step / kSteps;
  for (int i = 0; i < 50; ++i) {
    const double middle = 0.5 * (low + high);
    (rises(middle) ? low : high) = middle;
  }
  return low;
}

// The largest x^2 + y^2 up to which the radial distortion rises faster than the tangential one can fall, whose
// derivatives are a symmetric matrix of norm at most 6 |p| r: up to there no two points land on one.
inline double opencv_reach(const double (&k)[kDistortions]) {
  constexpr double kSteepest = 1.57;  // rad; beyond, slopes are above 1,000
  const double radial[kDistortions] = {k[0], k[1], 0, 0, k[4], k[5], k[6], k[7]};
  const double angle = rises_up_to(kSteepest, [&](double a) {
    const double r = std::tan(a), fall = 6 * (std::fabs(k[2]) + std::fabs(k[3])) * r;
    const Distorted<double> d = distort(radial, r, 0.0);
    return d.xx > fall && d.yy > fall;
  });
  return angle < kSteepest ? std::tan(angle) * std::tan(angle) : std::numeric_limits<double>::infinity();
}

inline double fisheye_reach(const double (&k)[kDistortions]) {
  return rises_up_to(3.141592653589793, [&](double angle) { return fisheye_radius(k, angle).slope > 0; });
}

// The point of the plane z = 1 that OpenCV's distortion moves to (x, y), by Newton's method; on the circle of `reach`
// where there is none.
inline PixelPoint<double> undistorted(const double (&k)[kDistortions], double reach, double x, double y) {
  PixelPoint<double> p{x, y};
  for (int i = 0; i < 30; ++i) {
    if (const double r2 = p.u * p.u + p.v * p.v; r2 > reach) p.u *= std::sqrt(reach / r2), p.v *= std::sqrt(reach / r2);
    const Distorted<double> d = distort(k, p.u, p.v);
    const double det = d.xx * d.yy - d.xy * d.xy, dx = x - d.x, dy = y - d.y;
    if (!(det > 1e-12)) break;
    p.u += (d.yy * dx - d.xy * dy) / det, p.v += (d.xx * dy - d.xy * dx) / det;
  }
  if (const double r2 = p.u * p.u + p.v * p.v; r2 > reach) p.u *= std::sqrt(reach / r2), p.v *= std::sqrt(reach / r2);
  return p;
}

// View::slope_*: those of the image's edges, undistorted, and the pinhole's margin.
template <class T>
void set_slopes(View<T>& view, const double (&k)[kDistortions], double reach) {
  constexpr int kSamples = 16;  // along an edge
  const double fx = static_cast<double>(view.fx), fy = static_cast<double>(view.fy);
  const double left = -static_cast<double>(view.cx) / fx, right = left + view.width / fx;
  const double top = -static_cast<double>(view.cy) / fy, bottom = top + view.height / fy;
  PixelPoint<double> low{1e300, 1e300}, high{-1e300, -1e300};
  const auto add = [&](double x, double y) {
    const PixelPoint<double> p = undistorted(k, reach, x, y);
    low = {min(p.u, low.u), min(p.v, low.v)}, high = {max(p.u, high.u), max(p.v, high.v)};
  };
  for (int i = 0; i <= kSamples; ++i) {
    const double x = left + (right - left) * i / kSamples, y = top + (bottom - top) * i / kSamples;
    add(x, top), add(x, bottom), add(left, y), add(right, y);
  }
  const double margin_x = (kFovClamp - 1.0) * 0.5 * (high.u - low.u),
               margin_y = (kFovClamp - 1.0) * 0.5 * (high.v - low.v);
  view.slope_low_x = static_cast<T>(low.u - margin_x), view.slope_high_x = static_cast<T>(high.u + margin_x);
  view.slope_low_y = static_cast<T>(low.v - margin_y), view.slope_high_y = static_cast<T>(high.v + margin_y);
}

}  // namespace detail

/// Makes a pinhole's view that of another model. For the host.
template <class T>
View<T> with_model(View<T> view, CameraModel model, const double (&distortion)[kDistortions]) {
  view.model = model;
  for (int i = 0; i < kDistortions; ++i) view.distortion[i] = static_cast<T>(distortion[i]);
  if (model == CameraModel::opencv) {
    const double reach = detail::opencv_reach(distortion);
    view.reach = static_cast<T>(reach);
    detail::set_slopes(view, distortion, reach);
  }
  if (model == CameraModel::opencv_fisheye) view.reach = static_cast<T>(detail::fisheye_reach(distortion));
  return view;
}

/// No part of the picture has more pixels a radian, as a pinhole's `focal` counts them: without its growth with the
/// angle to the axis, nor an equirectangular image's towards the poles. For the host.
template <class T>
double pixels_per_radian(const View<T>& view) {
  constexpr int kSamples = 64;
  constexpr double kMarginShare = 0.5 * (kFovClamp - 1.0) / kFovClamp;
  const auto d = [](T value) { return static_cast<double>(value); };
  const double fx = d(view.fx), fy = d(view.fy);
  double k[kDistortions], most = 1;
  for (int i = 0; i < kDistortions; ++i) k[i] = d(view.distortion[i]);
  if (view.model == CameraModel::opencv) {
    // Without the margin that the slopes have beyond the picture.
    const double margin_x = kMarginShare * (d(view.slope_high_x) - d(view.slope_low_x)),
                 margin_y = kMarginShare * (d(view.slope_high_y) - d(view.slope_low_y));
    const double x = max(-d(view.slope_low_x), d(view.slope_high_x)) - margin_x,
                 y = max(-d(view.slope_low_y), d(view.slope_high_y)) - margin_y;
    const double corner = min(std::sqrt(x * x + y * y), std::sqrt(d(view.reach)));
    const double radial[kDistortions] = {k[0], k[1], 0, 0, k[4], k[5], k[6], k[7]};
    for (int i = 1; i <= kSamples; ++i) {
      const double r = corner * i / kSamples;
      const Distorted<double> at = distort(radial, r, 0.0);
      most = max(max(at.xx, at.yy) + 6 * (std::fabs(k[2]) + std::fabs(k[3])) * r, most);  // NaN changes nothing
    }
  }
  if (view.model == CameraModel::opencv_fisheye) {
    const double x = max(d(view.cx), view.width - d(view.cx)) / fx, y = max(d(view.cy), view.height - d(view.cy)) / fy;
    for (int i = 1; i <= kSamples; ++i) {
      const double angle = d(view.reach) * i / kSamples;
      const FisheyeRadius<double> r = fisheye_radius(k, angle);
      if (r.radius * r.radius > x * x + y * y) break;
      most = max(angle < 1.57 ? max(r.slope, r.radius / std::sin(angle)) : r.slope, most);
    }
  }
  return most * max(fx, fy);
}

/// Width of the full circle on an equirectangular image, px; 0 for other models.
template <class T>
RGS_HD inline T period_px(const View<T>& view) {
  return view.model == CameraModel::equirectangular ? T(6.283185307179586) * view.fx : T(0);
}

/// Of all u + k period, k an integer, the one nearest to `place`; u where period is 0.
template <class T>
RGS_HD inline T nearest_copy(T u, T place, T period) {
  return period > T(0) ? u - period * std::floor((u - place) / period + T(0.5)) : u;
}

/// Copies of a Gaussian that one image may show: of an equirectangular one, where it repeats, 2.
template <class T>
RGS_HD inline std::uint32_t n_copies(const View<T>& view) {
  return view.model == CameraModel::equirectangular ? 2 : 1;
}

/// Pixels across of a band of an equirectangular image, which shows one copy of each Gaussian.
inline constexpr int kCopyBand = 32;

/// Makes `p`, a projection nearest to the image's middle, that copy of it: 0 is itself, 1 the one on the other side of
/// the middle. Returns the columns of tiles in the bands to whose middles this one is nearer. With tiles wider than
/// kCopyBand a tile is a band.
template <int Tile, class T>
RGS_HD inline TileSpan place_copy(const View<T>& view, std::uint32_t copy, TileGrid grid, Projected<T>& p) {
  if (n_copies(view) == 1) return {0, grid.columns};
  constexpr int kBand = max(kCopyBand, Tile);
  static_assert(kBand % Tile == 0);
  const bool other_is_right = p.mean.u < T(0.5) * static_cast<T>(view.width - 1);
  const T step = other_is_right ? period_px(view) : -period_px(view);
  const T between = (p.mean.u + T(0.5) * step - T(0.5) * T(kBand - 1)) / T(kBand);
  const int band = detail::ceil_index(clamp(between, T(0), static_cast<T>(grid.columns)));
  const int first_right = min(band * (kBand / Tile), grid.columns);
  if (copy != 0) p.mean.u += step;
  return other_is_right == (copy != 0) ? TileSpan{first_right, grid.columns} : TileSpan{0, first_right};
}

/// Depth of a camera point: of a fisheye and a panorama the distance, which is the same for all directions; else z.
template <class T>
RGS_HD inline T depth_of(const View<T>& view, const Vec3<T>& p) {
  const bool is_distance = view.model == CameraModel::opencv_fisheye || view.model == CameraModel::equirectangular;
  return is_distance ? std::sqrt(dot(p, p)) : p.z;
}

/// Where a camera point lands, and how that moves with the point.
template <class T>
struct Landing {
  PixelPoint<T> at;
  Vec3<T> du, dv;  ///< px per world unit, by the camera's x, y and z
  bool is_drawn;   ///< false: beyond View::reach; the rest is then unspecified
};

/// Of a point whose depth_of() is above 0; of an equirectangular view the copy nearest to the image's middle.
template <class T>
RGS_HD inline Landing<T> land(const View<T>& view, const Vec3<T>& p) {
  const T u0 = view.cx - T(0.5), v0 = view.cy - T(0.5), zero = T(0);
  switch (view.model) {
    case CameraModel::opencv: {
      const T inverse_z = T(1) / p.z, x = p.x * inverse_z, y = p.y * inverse_z;
      const Distorted<T> d = distort(view.distortion, x, y);
      const T sx = clamp(x, view.slope_low_x, view.slope_high_x), sy = clamp(y, view.slope_low_y, view.slope_high_y);
      const Distorted<T> at = distort(view.distortion, sx, sy);
      const T jx = view.fx * inverse_z, jy = view.fy * inverse_z;
      return {{view.fx * d.x + u0, view.fy * d.y + v0},
              {jx * at.xx, jx * at.xy, -jx * (at.xx * sx + at.xy * sy)},
              {jy * at.xy, jy * at.yy, -jy * (at.xy * sx + at.yy * sy)},
              x * x + y * y <= view.reach};
    }
    case CameraModel::opencv_fisheye: {
      const T across = p.x * p.x + p.y * p.y, rho = std::sqrt(across), angle = std::atan2(rho, p.z);
      const FisheyeRadius<T> r = fisheye_radius(view.distortion, angle);
      const T inverse_square = T(1) / (across + p.z * p.z);
      // On the axis the direction is any, and before the camera the image moves as much along as across it.
      const bool on_axis = rho <= T(1e-6) * std::fabs(p.z);
      const T c = on_axis ? T(1) : p.x / rho, s = on_axis ? zero : p.y / rho;
      const T along = r.slope * p.z * inverse_square;
      const T aside = on_axis && p.z > zero ? along : r.radius / max(rho, T(1e-6) * std::fabs(p.z));
      const T back = -r.slope * rho * inverse_square, mixed = (along - aside) * c * s;
      return {{view.fx * (r.radius * c) + u0, view.fy * (r.radius * s) + v0},
              {view.fx * (along * c * c + aside * s * s), view.fx * mixed, view.fx * back * c},
              {view.fy * mixed, view.fy * (along * s * s + aside * c * c), view.fy * back * s},
              angle <= view.reach};
    }
    case CameraModel::equirectangular: {
      // Straight above and below the camera as close beside it.
      const T least = T(1e-6) * std::fabs(p.y);
      const bool at_pole = p.x * p.x + p.z * p.z < least * least;
      const T x = at_pole ? zero : p.x, z = at_pole ? least : p.z;
      const T level = x * x + z * z, rho = std::sqrt(level), square = level + p.y * p.y;
      const T u = view.fx * std::atan2(x, z) + u0, v = view.fy * std::atan2(p.y, rho) + v0;
      const T jx = view.fx / level, jy = view.fy / (square * rho);
      return {{nearest_copy(u, T(0.5) * static_cast<T>(view.width - 1), period_px(view)), v},
              {jx * z, zero, -jx * x},
              {-jy * p.y * x, jy * level, -jy * p.y * z},
              true};
    }
    default:  // orthographic
      return {{view.fx * p.x + u0, view.fy * p.y + v0}, {view.fx, zero, zero}, {zero, view.fy, zero}, true};
  }
}

/// math::project() for every model. Projected::z is depth_of() the mean.
template <class T>
RGS_HD inline Projected<T> project_by_model(const View<T>& view, const Vec3<T>& mean, const Quaternion<T>& rotation,
                                            const Vec3<T>& scale, T opacity, T low_pass, AntiAliasing anti_aliasing) {
  if (view.model == CameraModel::pinhole) {
    return project(view, mean, rotation, scale, opacity, low_pass, anti_aliasing);
  }
  const Vec3<T> p = to_camera(view, mean);
  const T depth = depth_of(view, p);
  if (!in_depth_range(view, depth)) return {};
  const Landing<T> landing = land(view, p);
  if (!landing.is_drawn) return {};
  const T* w = view.rotation;
  const auto in_world = [w](const Vec3<T>& d) {
    return Vec3<T>{d.x * w[0] + d.y * w[3] + d.z * w[6], d.x * w[1] + d.y * w[4] + d.z * w[7],
                   d.x * w[2] + d.y * w[5] + d.z * w[8]};
  };
  const Cov2<T> cov = linear_covariance(in_world(landing.du), in_world(landing.dv), rotation, scale);
  return {landing.at, depth, footprint(cov, opacity, low_pass, anti_aliasing)};
}

/// view_direction() for every model: the rays of an orthographic view are parallel.
template <class T>
RGS_HD inline Vec3<T> direction_by_model(const View<T>& view, const Vec3<T>& p) {
  if (view.model != CameraModel::orthographic) return view_direction(view, p);
  return {view.rotation[6], view.rotation[7], view.rotation[8]};
}

}  // namespace rgs::math
