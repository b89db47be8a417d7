// sh.hpp - colour from real spherical harmonics of degree 0..3.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/hd.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// Values of the basis functions, ordered by degree l, then m = -l .. l; 0 above the degree.
template <class T>
struct ShBasis {
  T y[16];
};

/// Real spherical harmonics with the Condon-Shortley signs that 3DGS and its predecessors use (Sloan 2008, appendix A2;
/// Kerbl et al. 2023), at the unit vector d, for degrees 0..degree.
template <class T>
RGS_HD inline ShBasis<T> sh_basis(int degree, const Vec3<T>& d) {
  ShBasis<T> b{};
  b.y[0] = T(0.28209479177387814);  // 1/2 sqrt(1/pi)
  if (degree < 1) return b;
  const T c1 = T(0.4886025119029199);  // 1/2 sqrt(3/pi)
  b.y[1] = -c1 * d.y;
  b.y[2] = c1 * d.z;
  b.y[3] = -c1 * d.x;
  if (degree < 2) return b;
  const T xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  const T xy = d.x * d.y, yz = d.y * d.z, xz = d.x * d.z;
  const T c2 = T(1.0925484305920792);  // 1/2 sqrt(15/pi)
  b.y[4] = c2 * xy;
  b.y[5] = -c2 * yz;
  b.y[6] = T(0.31539156525252005) * (T(2) * zz - xx - yy);  // 1/4 sqrt(5/pi)
  b.y[7] = -c2 * xz;
  b.y[8] = T(0.5462742152960396) * (xx - yy);  // 1/4 sqrt(15/pi)
  if (degree < 3) return b;
  const T c33 = T(0.5900435899266435);  // 1/4 sqrt(35/(2 pi))
  const T c31 = T(0.4570457994644658);  // 1/4 sqrt(21/(2 pi))
  b.y[9] = -c33 * d.y * (T(3) * xx - yy);
  b.y[10] = T(2.890611442640554) * xy * d.z;  // 1/2 sqrt(105/pi)
  b.y[11] = -c31 * d.y * (T(4) * zz - xx - yy);
  b.y[12] = T(0.3731763325901154) * d.z * (T(2) * zz - T(3) * xx - T(3) * yy);  // 1/4 sqrt(7/pi)
  b.y[13] = -c31 * d.x * (T(4) * zz - xx - yy);
  b.y[14] = T(1.445305721320277) * d.z * (xx - yy);  // 1/4 sqrt(105/pi)
  b.y[15] = -c33 * d.x * (xx - T(3) * yy);
  return b;
}

namespace detail {

// c + sum_m y_k sh(k) over the coefficients of degree l.
template <class T, class Coefficients>
RGS_HD inline Vec3<T> add_band(int l, const ShBasis<T>& basis, const Coefficients& sh, Vec3<T> c) {
  for (int k = l * l; k < (l + 1) * (l + 1); ++k) {
    const Vec3<T> s = sh(k);
    c = {multiply_add(basis.y[k], s.x, c.x), multiply_add(basis.y[k], s.y, c.y), multiply_add(basis.y[k], s.z, c.z)};
  }
  return c;
}

template <class T>
RGS_HD inline Vec3<T> displayed(const Vec3<T>& c) {
  return {max(c.x + T(0.5), T(0)), max(c.y + T(0.5), T(0)), max(c.z + T(0.5), T(0))};
}

}  // namespace detail

/// Colour of a Gaussian: max(0, 1/2 + sum_k y_k sh(k)). `sh(k)` returns coefficient k as Vec3 R G B, decoded from the
/// caller's storage; it is called for k < (degree + 1)^2.
template <class T, class Coefficients>
RGS_HD inline Vec3<T> sh_color(int degree, const ShBasis<T>& basis, const Coefficients& sh) {
  Vec3<T> c{0, 0, 0};
  for (int l = 0; l <= degree; ++l) c = detail::add_band(l, basis, sh, c);
  return detail::displayed(c);
}

/// The same from coefficients codes(k) times the step of their degree l, steps(l), channel by channel: a degree's codes
/// are summed before they are scaled.
template <class T, class Codes, class Steps>
RGS_HD inline Vec3<T> sh_color(int degree, const ShBasis<T>& basis, const Codes& codes, const Steps& steps) {
  Vec3<T> c{0, 0, 0};
  for (int l = 0; l <= degree; ++l) {
    const Vec3<T> band = detail::add_band(l, basis, codes, Vec3<T>{0, 0, 0}), step = steps(l);
    c = {multiply_add(step.x, band.x, c.x), multiply_add(step.y, band.y, c.y), multiply_add(step.z, band.z, c.z)};
  }
  return detail::displayed(c);
}

}  // namespace rgs::math
