// vec.hpp - small values that the math headers pass around, and host/device-safe comparisons.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <type_traits>

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

template <class T>
RGS_HD constexpr Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// std::min and std::max are host-only for nvcc without a flag. These return b if a is NaN; b must not be NaN. The
// device has one instruction for them, where comparison and choice would be two.
template <class T>
RGS_HD constexpr T min(T a, T b) {
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) return ::fminf(a, b);
#endif
  return a < b ? a : b;
}
template <class T>
RGS_HD constexpr T max(T a, T b) {
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) return ::fmaxf(a, b);
#endif
  return a > b ? a : b;
}
/// x in [low, high]; low if x is NaN.
template <class T>
RGS_HD constexpr T clamp(T x, T low, T high) {
  return min(max(x, low), high);
}

/// a b + c: one instruction with one rounding on the device, two operations on the host. For sums whose last bits do
/// not matter.
template <class T>
RGS_HD inline T multiply_add(T a, T b, T c) {
#if defined(__CUDA_ARCH__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

}  // namespace rgs::math
