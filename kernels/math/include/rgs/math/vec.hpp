// vec.hpp - the few small values that the math headers pass around, and host/device-safe comparisons.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/hd.hpp"

namespace rgs::math {

template <class T>
struct Vec3 {
  T x, y, z;
};

/// Quaternion w + xi + yj + zk.
template <class T>
struct Quaternion {
  T w, x, y, z;
};

template <class T>
RGS_HD constexpr T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// std::min and std::max are host-only for nvcc without a flag; these return b where a is NaN.
template <class T>
RGS_HD constexpr T min(T a, T b) {
  return a < b ? a : b;
}
template <class T>
RGS_HD constexpr T max(T a, T b) {
  return a > b ? a : b;
}
/// x in [low, high]; low where x is NaN.
template <class T>
RGS_HD constexpr T clamp(T x, T low, T high) {
  return min(max(x, low), high);
}

}  // namespace rgs::math
