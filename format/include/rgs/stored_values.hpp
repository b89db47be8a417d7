// stored_values.hpp - which stored values are legal, and counts of those at the ends of their range, for the
// declarations; on host and device. docs/format/FORMAT.md "Attributes".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/api.hpp"
#include "rgs/hd.hpp"
#include "rgs/layout.hpp"
#include "rgs/quantize.hpp"

namespace RGS_API rgs {

/// Stored quaternions have a squared norm within 2^-8 of 1: twice the encoder's tolerance for unnormalised ones.
inline constexpr double kStoredNormTolerance = 0x1p-8;

RGS_HD inline bool is_finite(float value) {
  return (detail::bits_of(value) & 0x7F800000u) != 0x7F800000u;
}
/// Of FP16 w, x, y, z. Exact: squares of FP16 numbers and their sums fit 53 bits.
RGS_HD inline bool is_unit_quaternion(const std::uint16_t codes[4]) {
  double squared = 0;
  for (int i = 0; i < 4; ++i) {
    const double component = static_cast<double>(float_from_half(codes[i]));
    squared += component * component;
  }
  return squared - 1.0 <= kStoredNormTolerance && squared - 1.0 >= -kStoredNormTolerance;
}
RGS_HD constexpr bool has_sign_bit(std::uint16_t code) {
  return (code & 0x8000u) != 0;
}
/// Finite and not negative.
RGS_HD constexpr bool is_stored_scale(std::uint16_t code) {
  return code < 0x7C00u;
}
/// 0 to 1.
RGS_HD constexpr bool is_stored_opacity(std::uint16_t code) {
  return code <= 0x3C00u;
}
/// Four bytes of an SH row: none is -128 or has a bit outside `mask`.
RGS_HD constexpr bool are_stored_codes(std::uint32_t codes, std::uint32_t mask) {
  const std::uint32_t flipped = codes ^ 0x80808080u;  // a byte is 0 where a code is -128
  return ((flipped - 0x01010101u) & ~flipped & 0x80808080u) == 0 && (codes & ~mask) == 0;
}

struct ValueCounts {
  std::uint64_t scale_subnormal = 0, scale_zero = 0, opacity_zero = 0, opacity_one = 0;

  /// A row of GEOM.
  RGS_HD void add(const std::uint16_t geometry[8]) {
    for (int k = 4; k < 7; ++k) {
      scale_zero += geometry[k] == 0;
      scale_subnormal += geometry[k] != 0 && geometry[k] < 0x0400;
    }
    opacity_zero += geometry[7] == 0;
    opacity_one += geometry[7] == 0x3C00;
  }
  void add(const ValueCounts& other) {
    scale_subnormal += other.scale_subnormal;
    scale_zero += other.scale_zero;
    opacity_zero += other.opacity_zero;
    opacity_one += other.opacity_one;
  }
  void declare(Declarations& d) const {
    d.n_scale_subnormal = scale_subnormal;
    d.n_scale_zero = scale_zero;
    d.n_opacity_zero = opacity_zero;
    d.n_opacity_one = opacity_one;
  }
};

}  // namespace rgs
