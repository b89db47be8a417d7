// tie_order.hpp - which of two Gaussians of equal depth is drawn first: an order by their own values.
// SPDX-License-Identifier: Apache-2.0
//
// Compares value after value, as numbers, until two differ. So the picture does not depend on the order of the file,
// nor on an origin or rounding of the means, as long as different values stay different. A Morton curve would keep
// neighbours together but lacks this property: points of a grid lie on the borders of its cells.
#pragma once

#include <cstdint>
#include <cstring>

#include "rgs/hd.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

/// Orders as the numbers do: -infinity lowest, -0 equal to 0, infinity highest; NaN beyond both ends, by their bits.
RGS_HD inline std::uint32_t order_bits(float value) {
  constexpr std::uint32_t kSign = 1u << 31;
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  if (bits == kSign) bits = 0;
  return (bits & kSign) != 0 ? ~bits : bits | kSign;
}

/// -1, 0 or 1: which number comes first.
RGS_HD inline int compare_values(float a, float b) {
  const std::uint32_t from = order_bits(a), to = order_bits(b);
  return from < to ? -1 : from > to ? 1 : 0;
}

/// -1, 0 or 1: the tie order of Gaussians a and b of a scene, 0 if all their values are equal. Compares mean x, y, z,
/// opacity, scale x, y, z, the coefficient of SH degree 0 (r, g, b), rotation w, x, y, z, and then the other
/// coefficients. `scene` has mean(i, axis), opacity(i), scale(i), rotation(i), n_sh() and sh(i, k), activated and
/// dequantised, for k below n_sh() = 3 (degree + 1)^2, coefficients before channels.
template <class Scene>
RGS_HD inline int compare_ties(const Scene& scene, std::uint32_t a, std::uint32_t b) {
  for (int axis = 0; axis < 3; ++axis) {
    if (const int c = compare_values(scene.mean(a, axis), scene.mean(b, axis)); c != 0) return c;
  }
  const Vec3<float> s = scene.scale(a), t = scene.scale(b);
  const Quaternion<float> q = scene.rotation(a), r = scene.rotation(b);
  const float from[] = {
      scene.opacity(a), s.x, s.y, s.z, scene.sh(a, 0), scene.sh(a, 1), scene.sh(a, 2), q.w, q.x, q.y, q.z};
  const float to[] = {
      scene.opacity(b), t.x, t.y, t.z, scene.sh(b, 0), scene.sh(b, 1), scene.sh(b, 2), r.w, r.x, r.y, r.z};
  for (int k = 0; k < 11; ++k) {
    if (const int c = compare_values(from[k], to[k]); c != 0) return c;
  }
  for (int k = 3; k < scene.n_sh(); ++k) {
    if (const int c = compare_values(scene.sh(a, k), scene.sh(b, k)); c != 0) return c;
  }
  return 0;
}

/// Whether Gaussian a precedes b at equal depth. Gaussians with equal values, whose order does not change the picture,
/// are ordered by index.
template <class Scene>
RGS_HD inline bool ties_before(const Scene& scene, std::uint32_t a, std::uint32_t b) {
  const int c = compare_ties(scene, a, b);
  return c != 0 ? c < 0 : a < b;
}

}  // namespace rgs::math
