// archive_formulas.hpp - docs/format/ARCHIVE.md "Rows", number by number, without branches, so that loops vectorise.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>

#include "rgs/hd.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {

/// 2^k, -1022 <= k <= 1023.
RGS_HD inline double power_of_two(std::int32_t k) {
  return std::bit_cast<double>(static_cast<std::uint64_t>(std::int64_t{1023} + k) << 52);
}

RGS_HD inline float limited_mean(double x) {
  constexpr double kMax = std::numeric_limits<float>::max();
  const double low = x < -kMax ? -kMax : x;
  return static_cast<float>(low > kMax ? kMax : low) + 0.f;
}

/// Mean on one axis from its coordinate below 2^mean_bits. mean_bits <= min(mean_cells + 9, 28), so no octave exceeds
/// 2^255.
RGS_HD inline float grid_mean(std::uint32_t coordinate, std::uint32_t mean_bits, std::uint32_t mean_cells,
                              double centre, double half_width) {
  const auto cells = std::int32_t{1} << mean_cells;
  const auto q = static_cast<std::int32_t>(coordinate) - (std::int32_t{1} << (mean_bits - 1));
  const std::int32_t n = q >= 0 ? q : -1 - q, octave = n >> mean_cells;
  const double fraction =
      (static_cast<double>(n & (cells - 1)) + 0.5) * power_of_two(-static_cast<std::int32_t>(mean_cells));
  const double t = octave > 0 ? (1 + fraction) * power_of_two(octave - 1) : fraction;
  return limited_mean(centre + half_width * (q >= 0 ? t : -t));
}

/// Unit quaternion w x y z, w not negative, from the three stored components; component `largest` is the fourth.
RGS_HD inline void unit_quaternion(double r0, double r1, double r2, std::int32_t largest, float out[4]) {
  const double s = (r0 * r0 + r1 * r1) + r2 * r2, rest = s < 1 ? 1 - s : 0;
  const double w = std::sqrt(rest), length = std::sqrt(s + w * w);
  const double q0 = (largest == 0 ? w : r0) / length,
               q1 = (largest == 1  ? w
                     : largest < 1 ? r0
                                   : r1) /
                    length,
               q2 = (largest == 2  ? w
                     : largest < 2 ? r1
                                   : r2) /
                    length,
               q3 = (largest == 3 ? w : r2) / length;
  const double sign = q0 < 0 ? -1 : 1;
  out[0] = static_cast<float>(sign * q0), out[1] = static_cast<float>(sign * q1);
  out[2] = static_cast<float>(sign * q2), out[3] = static_cast<float>(sign * q3);
}

/// A value above degree 0 from its code; and what predicts the next: 256 times an exponential average.
RGS_HD inline std::int32_t smoothed_value(std::int16_t code, std::int32_t step, std::int32_t state) {
  const std::int32_t value = code * step + ((state + 128) >> 8);
  return value < -32768 ? -32768 : value > 32767 ? 32767 : value;
}
RGS_HD inline std::int32_t smoothed_state(std::int32_t value, std::int32_t state, std::int32_t recent,
                                          std::int32_t kept) {
  return recent * value + ((kept * state) >> 8);
}

/// The same of degree 0, in 1/65536.
RGS_HD inline std::int64_t smoothed_dc_value(std::int16_t code, std::int64_t step, std::int64_t state) {
  constexpr std::int64_t kMost = std::int64_t{1} << 30;
  const std::int64_t value = code * step + ((state + 128) >> 8);
  return value < -kMost ? -kMost : value > kMost ? kMost : value;
}
RGS_HD inline std::int64_t smoothed_dc_state(std::int64_t value, std::int64_t state, std::int32_t recent,
                                             std::int32_t kept) {
  return recent * value + ((kept * state) >> 8);
}

inline constexpr double kMostOctaves = 0x1p23;

/// log2 of a scale in 1/65536, limited. Exact: |code * step| is below 2^38.
RGS_HD inline std::int32_t scale_octaves(std::int32_t base, std::uint32_t step, std::int16_t code) {
  const double octaves =
      static_cast<double>(base) + static_cast<double>(code) * static_cast<double>(static_cast<std::int32_t>(step));
  const double low = octaves < -kMostOctaves ? -kMostOctaves : octaves;
  return static_cast<std::int32_t>(low > kMostOctaves ? kMostOctaves : low);
}
/// 2^(octaves / 65536) without its exponent octaves >> 16: about 1 to 2.
RGS_HD inline float scale_significand(std::int32_t octaves) {
  const double y = static_cast<double>(octaves & 0xFFFF) * 0x1p-16;
  return static_cast<float>(
      ((((0.001893754059 * y + 0.008949590422) * y + 0.05586033708) * y + 0.2401418182) * y + 0.6931544897) * y +
      0.9999998984);
}
/// The scale times 2^scale_exponent; infinite above FP32.
RGS_HD inline float stored_scale(std::int32_t octaves, std::int32_t scale_exponent) {
  return static_cast<float>(static_cast<double>(scale_significand(octaves)) *
                            power_of_two((octaves >> 16) + scale_exponent));
}

RGS_HD inline float stored_opacity(std::uint16_t code, std::uint32_t levels) {
  const float level = code == 0 ? 0.25f : static_cast<float>(code);
  return level / static_cast<float>(static_cast<std::int32_t>(levels));
}

/// A value of a row of GEOM: w x y z, scales, opacity.
RGS_HD inline std::uint16_t geometry_half(int k, float value) {
  const std::uint16_t half = half_from_float(value);
  if (k == 0) return static_cast<std::uint16_t>(half & 0x7FFFu);
  if (k < 4 || k == 7) return half;
  return half < 0x7BFF ? half : std::uint16_t{0x7BFF};
}

/// History of a row's code magnitudes, in 16 bits so that vectors hold many. (13 h + 128 m) div 16 is h - (3 h + 15)
/// div 16 + 8 m, and h is at most 10880.
RGS_HD inline std::uint16_t next_history(std::uint16_t history, std::int16_t code) {
  const std::int16_t limited = std::clamp<std::int16_t>(code, -255, 255);
  const auto magnitude = static_cast<std::uint16_t>(limited < 0 ? -limited : limited);
  const auto decay = static_cast<std::uint16_t>(static_cast<std::uint16_t>(3 * history + 15) >> 4);
  return static_cast<std::uint16_t>(history - decay + 8 * magnitude);
}
RGS_HD inline std::uint16_t size_of_history(std::uint16_t history) {
  std::uint16_t size = 0;
  constexpr std::array<std::uint16_t, 7> kLimits{3, 7, 12, 22, 37, 60, 98};
  for (const std::uint16_t limit : kLimits) size = static_cast<std::uint16_t>(size + (history >= limit));
  return size;
}

}  // namespace rgs::detail
