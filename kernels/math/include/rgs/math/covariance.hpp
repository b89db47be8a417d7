// covariance.hpp - a Gaussian's spread on the image: EWA projection, low-pass, conic.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "rgs/hd.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// Symmetric 2x2 covariance on the image, px^2.
template <class T>
struct Cov2 {
  T xx, xy, yy;
};

/// Inverse covariance: the quadratic form a x^2 + 2 b x y + c y^2, 1/px^2. (The paper's b is twice this one.)
template <class T>
struct Conic {
  T a, b, c;
};

template <class T>
RGS_HD inline T determinant(const Cov2<T>& cov) {
  return cov.xx * cov.yy - cov.xy * cov.xy;
}

/// Rotation matrix of a unit quaternion, row-major; columns are the Gaussian's local axes.
template <class T>
RGS_HD inline void rotation_matrix(const Quaternion<T>& q, T (&r)[9]) {
  const T two = T(2);
  r[0] = T(1) - two * (q.y * q.y + q.z * q.z);
  r[1] = two * (q.x * q.y - q.w * q.z);
  r[2] = two * (q.x * q.z + q.w * q.y);
  r[3] = two * (q.x * q.y + q.w * q.z);
  r[4] = T(1) - two * (q.x * q.x + q.z * q.z);
  r[5] = two * (q.y * q.z - q.w * q.x);
  r[6] = two * (q.x * q.z - q.w * q.y);
  r[7] = two * (q.y * q.z + q.w * q.x);
  r[8] = T(1) - two * (q.x * q.x + q.y * q.y);
}

/// Covariance on the image, before the low-pass, of a Gaussian with unit rotation and standard deviations s in world
/// units. du and dv, the rows of J W: how its place on the image moves with the mean, px per world unit in world axes.
///
/// Zwicker et al. 2001 (EWA), eq. 31: J W Sigma W^T J^T with Sigma = R S S R^T (Kerbl et al. 2023, eqs. 5 and 6).
/// Formed as M M^T with M = J W R S, 2x3, which stays positive semi-definite under rounding and does not need Sigma.
template <class T>
RGS_HD inline Cov2<T> linear_covariance(const Vec3<T>& du, const Vec3<T>& dv, const Quaternion<T>& rotation,
                                        const Vec3<T>& s) {
  T r[9];
  rotation_matrix(rotation, r);
  const Vec3<T> axis_x{r[0], r[3], r[6]}, axis_y{r[1], r[4], r[7]}, axis_z{r[2], r[5], r[8]};
  const Vec3<T> mu{dot(du, axis_x) * s.x, dot(du, axis_y) * s.y, dot(du, axis_z) * s.z};
  const Vec3<T> mv{dot(dv, axis_x) * s.x, dot(dv, axis_y) * s.y, dot(dv, axis_z) * s.z};
  return {dot(mu, mu), dot(mu, mv), dot(mv, mv)};
}

/// The same for a pinhole and a mean p in the camera's axes, p.z > 0.
template <class T>
RGS_HD inline Cov2<T> project_covariance(const View<T>& view, const Vec3<T>& p, const Quaternion<T>& rotation,
                                         const Vec3<T>& s) {
  const T inverse_z = T(1) / p.z;
  const T slope_x = clamp(p.x * inverse_z, view.slope_low_x, view.slope_high_x);
  const T slope_y = clamp(p.y * inverse_z, view.slope_low_y, view.slope_high_y);
  const T jx = view.fx * inverse_z, jy = view.fy * inverse_z;
  const T* w = view.rotation;
  // Rows of J W: d(u)/d(world) = fx/z (w_x - x/z w_z), and v likewise.
  const Vec3<T> du{jx * (w[0] - slope_x * w[6]), jx * (w[1] - slope_x * w[7]), jx * (w[2] - slope_x * w[8])};
  const Vec3<T> dv{jy * (w[3] - slope_y * w[6]), jy * (w[4] - slope_y * w[7]), jy * (w[5] - slope_y * w[8])};
  return linear_covariance(du, dv, rotation, s);
}

/// A projected Gaussian.
template <class T>
struct Footprint {
  Cov2<T> cov;     ///< low-pass included
  Conic<T> conic;  ///< inverse of cov
  T opacity;       ///< at the mean
  bool valid;      ///< false: cov has no finite inverse and the Gaussian is not drawn
};

/// Adds the low-pass (px^2) and inverts. The Mip filter multiplies the opacity by sqrt(det before / det after), which
/// preserves the integral of the widened Gaussian (Yu et al. 2024, eq. 10).
template <class T>
RGS_HD inline Footprint<T> footprint(const Cov2<T>& projected, T opacity, T low_pass, AntiAliasing anti_aliasing) {
  const Cov2<T> cov{projected.xx + low_pass, projected.xy, projected.yy + low_pass};
  const T det = determinant(cov);
  if (anti_aliasing == AntiAliasing::mip_splatting) {
    opacity *= std::sqrt(max(T(kMipRatioMin), determinant(projected) / det));
  }
  const T inverse_det = T(1) / det;
  const Conic<T> conic{cov.yy * inverse_det, -cov.xy * inverse_det, cov.xx * inverse_det};
  // Products overflow for huge variances and cancel to zero or below for needles; neither has a usable inverse.
  const bool valid = det > T(0) && std::isfinite(det) && std::isfinite(conic.a) && std::isfinite(conic.c);
  return {cov, conic, opacity, valid};
}

}  // namespace rgs::math
