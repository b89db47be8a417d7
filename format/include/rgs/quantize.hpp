// quantize.hpp - the quantiser: FP16 and INT8 codes of Gaussian attributes, defined here alone, for host and device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "rgs/api.hpp"
#include "rgs/hd.hpp"

namespace RGS_API rgs {

namespace detail {

RGS_HD inline std::uint32_t bits_of(float value) {
  std::uint32_t bits;
  memcpy(&bits, &value, sizeof bits);
  return bits;
}

RGS_HD inline float float_of(std::uint32_t bits) {
  float value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

/// Bits of |value|, in the order of the magnitudes; infinity and NaN above every number.
RGS_HD inline std::int32_t magnitude_bits(float value) {
  return static_cast<std::int32_t>(bits_of(value) & 0x7FFFFFFFu);
}

}  // namespace detail

// ---- FP16 (IEEE 754 binary16) ---------------------------------------------------------------------------------------

/// Largest finite, smallest normal and smallest subnormal FP16.
inline constexpr float kHalfMax = 65504.f;
inline constexpr float kHalfMinNormal = 0x1p-14f;
inline constexpr float kHalfMinSubnormal = 0x1p-24f;

/// Rounds to nearest, ties to even; overflow gives infinity; NaN stays a (quiet) NaN with its payload's top bits.
RGS_HD inline std::uint16_t half_from_float(float value) {
  const std::uint32_t bits = detail::bits_of(value);
  const std::uint32_t sign = bits >> 16 & 0x8000u;
  const std::uint32_t magnitude = bits & 0x7FFFFFFFu;
  std::uint32_t half;
  if (magnitude >= 0x47800000u) {  // 2^16 and above, infinity, NaN
    half = magnitude > 0x7F800000u ? 0x7E00u | (magnitude >> 13 & 0x3FFu) : 0x7C00u;
  } else if (magnitude < 0x38800000u) {  // below 2^-14: subnormal; one FP32 addition does shift and rounding
    half = detail::bits_of(detail::float_of(magnitude) + 0.5f) - 0x3F000000u;
  } else {  // normal: add half a unit less one, plus the bit that decides a tie; a carry rightly moves the exponent
    half = (magnitude + 0xFFFu + (magnitude >> 13 & 1u) - 0x38000000u) >> 13;
  }
  return static_cast<std::uint16_t>(sign | half);
}

/// Exact.
RGS_HD inline float float_from_half(std::uint16_t half) {
#if defined(__CUDA_ARCH__)
  float value;
  asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"(half));
  return value;
#else
  const std::uint32_t sign = static_cast<std::uint32_t>(half & 0x8000u) << 16;
  const std::uint32_t magnitude = half & 0x7FFFu;
  if (magnitude >= 0x7C00u) {  // infinity; NaN becomes quiet, as conversion instructions make it
    return detail::float_of(sign | 0x7F800000u | magnitude << 13 | (magnitude > 0x7C00u ? 0x400000u : 0u));
  }
  // Re-biases the exponent by a multiplication, which also normalises subnormals: 2^112 = 2^(127 - 15).
  return detail::float_of(sign | detail::bits_of(detail::float_of(magnitude << 13) * 0x1p112f));
#endif
}

// ---- SH: symmetric INT8, one step per degree and channel (RoofGS paper, eq. "quant")

inline constexpr int kShCodeMax = 127;
/// Nonzero steps lie in this range, which keeps them and their products normal numbers.
inline constexpr float kShStepMin = 0x1p-107f;
inline constexpr float kShStepMax = 0x1p93f;
/// A largest magnitude below this is stored as zero.
inline constexpr float kShFlush = 127 * kShStepMin;
/// SH coefficients above this magnitude are damaged input. Both bounds are exactly 127 steps, so decoded values are
/// within them too.
inline constexpr float kShLimit = 127 * kShStepMax;

/// Step for coefficients of magnitude at most `max_abs`: max_abs / 127, rounded up to 17 significant bits. Then step *
/// code is exact in FP32 for every code: decoding does not round, and re-encoding decoded values gives the same step
/// and codes. Rounding up costs at most 2^-16 of the step and never clips.
RGS_HD inline float sh_step(float max_abs) {
  if (!(max_abs >= kShFlush)) return 0.f;
  const float step = max_abs / static_cast<float>(kShCodeMax);
  std::uint32_t bits = (detail::bits_of(step) + 0x7Fu) & ~0x7Fu;
  // The quotient was rounded; if it lost the last bit of an exact 17-bit value, 127 steps fall short.
  if (detail::float_of(bits) * static_cast<float>(kShCodeMax) < max_abs) bits += 0x80u;
  return detail::float_of(bits);
}

/// round(value / step), ties to even, clamped to +-127; 0 for step 0. |value - step * code| <= step / 2 (+ 1 ulp of
/// value) for |value| <= 127 * step.
RGS_HD inline std::int8_t quantize_sh(float value, float step) {
  const float quotient = value / (step > 0.f ? step : 1.f);
  const float low = quotient > -127.f ? quotient : -127.f;  // also maps NaN to a code
  const float clamped = low < 127.f ? low : 127.f;
  // 1.5 * 2^23 pushes the fraction out of the significand, so the FP32 addition rounds half to even.
  const float rounded = (clamped + 12582912.f) - 12582912.f;
  return static_cast<std::int8_t>(static_cast<std::int32_t>(step > 0.f ? rounded : 0.f));
}

/// Exact: the product of a 17-bit step and a 7-bit code.
RGS_HD inline float dequantize_sh(std::int8_t code, float step) {
  return step * static_cast<float>(code);
}

// ---- geometry: FP16, activated -----------------------------------------------------------------------------------

/// Opacity in [0, 1]; infinite logits give 1 and 0. In FP64, so that hosts agree after rounding to FP32.
RGS_HD inline float opacity_from_logit(float logit) {
  return static_cast<float>(1.0 / (1.0 + std::exp(-static_cast<double>(logit))));
}

/// Inverse of opacity_from_logit for stored opacities. 1 and 0, which have no finite logit, give ln(2^13 - 1) = 9.01
/// and -18, which encode to 1 and 0 again.
RGS_HD inline float logit_from_opacity(float opacity) {
  if (opacity >= 1.f) return 9.0107908f;
  if (opacity <= 0.f) return -18.f;
  const double o = opacity;
  return static_cast<float>(std::log(o / (1.0 - o)));
}

/// -inf gives 0: a flat Gaussian.
RGS_HD inline float scale_from_log(float log_scale) {
  return static_cast<float>(std::exp(static_cast<double>(log_scale)));
}

/// Log-scales above 60 are damaged input. Below -60 scales are next to 0, or 0.
inline constexpr float kMaxLogScale = 60.f;

/// Logarithm of a stored scale. 0, whose -inf many programs cannot read, gives that of 2^-26 * 2^-scale_exponent, which
/// is stored as 0 again. At most kMaxLogScale, which FP16 rounding can exceed; the bound is stored as the same code
/// again. Infinity and NaN, which other formats may hold, stay.
RGS_HD inline float log_from_scale(float scale, int scale_exponent) {
  const double value = scale <= 0.f ? std::ldexp(1.0, -26 - scale_exponent) : static_cast<double>(scale);
  const float log_scale = static_cast<float>(std::log(value));
  const bool rounded = log_scale > kMaxLogScale && log_scale < 2 * kMaxLogScale;
  return rounded ? kMaxLogScale : log_scale;
}

/// Largest magnitude of a file's exponent E: every FP16 scale times 2^-E, and three times that, is then an exact finite
/// FP32 number.
inline constexpr int kMaxScaleExponent = 110;

/// Rotations of FP16 numbers whose squared norm is this near to 1 are stored unchanged. FP16 rounding moves a unit
/// quaternion's squared norm by little more than 2^-10, so a decoded rotation is not normalised again, and re-encoding
/// is exact.
inline constexpr double kUnitNormTolerance = 0x1p-9;

/// Unit quaternion w, x, y, z with w >= 0 in FP16. `rotation` must be finite and nonzero.
RGS_HD inline void quantize_rotation(const float rotation[4], std::uint16_t out[4]) {
  double squared = 0;
  bool stored = true;  // all components are FP16 numbers
  for (int i = 0; i < 4; ++i) {
    squared += static_cast<double>(rotation[i]) * static_cast<double>(rotation[i]);
    stored = stored && float_from_half(half_from_float(rotation[i])) == rotation[i];
  }
  const double deviation = squared > 1.0 ? squared - 1.0 : 1.0 - squared;
  const double factor = stored && deviation <= kUnitNormTolerance ? 1.0 : 1.0 / std::sqrt(squared);
  const double sign = rotation[0] < 0.f ? -factor : factor;  // q and -q are the same rotation
  for (int i = 0; i < 4; ++i) out[i] = half_from_float(static_cast<float>(static_cast<double>(rotation[i]) * sign));
  out[0] = static_cast<std::uint16_t>(out[0] & 0x7FFFu);  // -0 becomes 0
}

/// Unit quaternion w, x, y, z; FP16 rounding moves the stored norm by up to 2^-11.
RGS_HD inline void dequantize_rotation(const std::uint16_t codes[4], float out[4]) {
  float squared = 0;
  for (int i = 0; i < 4; ++i) {
    out[i] = float_from_half(codes[i]);
    squared += out[i] * out[i];
  }
  const float factor = 1.f / std::sqrt(squared);
  for (int i = 0; i < 4; ++i) out[i] *= factor;
}

/// FP16 of scale * 2^scale_exponent (the product is exact).
RGS_HD inline std::uint16_t quantize_scale(float scale, int scale_exponent) {
  return half_from_float(static_cast<float>(std::ldexp(static_cast<double>(scale), scale_exponent)));
}

/// Exact.
RGS_HD inline float dequantize_scale(std::uint16_t code, int scale_exponent) {
  return static_cast<float>(std::ldexp(static_cast<double>(float_from_half(code)), -scale_exponent));
}

/// The file's exponent for scales between min_scale and max_scale (> 0): the one nearest to 0 that puts both into
/// FP16's normal range with a factor of two to spare; if the range is too wide, the one that brings the largest to at
/// most 2^15, so that losses are at the small end, where they are counted. At most kMaxScaleExponent, its value if all
/// scales are 0, which decode to 0 again. Both bounds are first rounded to FP16's 11 significant bits, so that decoded
/// scales choose the same exponent.
RGS_HD inline int choose_scale_exponent(float min_scale, float max_scale) {
  struct Local {
    RGS_HD static double rounded(float value) {
      int exponent = 0;
      const double fraction = std::frexp(static_cast<double>(value), &exponent);  // in [0.5, 1)
      const double scaled = std::ldexp(fraction, 11) + 0x1.8p52 - 0x1.8p52;       // nearest integer, ties to even
      return std::ldexp(scaled, exponent - 11);
    }
    // Largest k with value * 2^k <= 2^limit.
    RGS_HD static int largest_exponent(double value, int limit) {
      int exponent = 0;
      const double fraction = std::frexp(value, &exponent);
      return limit - (fraction == 0.5 ? exponent - 1 : exponent);
    }
    // Smallest k with value * 2^k >= 2^limit.
    RGS_HD static int smallest_exponent(double value, int limit) {
      int exponent = 0;
      std::frexp(value, &exponent);
      return limit - (exponent - 1);
    }
  };
  if (!(max_scale > 0.f)) return kMaxScaleExponent;
  const int largest = Local::largest_exponent(Local::rounded(max_scale), 15);
  const int high = largest < kMaxScaleExponent ? largest : kMaxScaleExponent;
  if (!(min_scale > 0.f)) return high;
  const int low = Local::smallest_exponent(Local::rounded(min_scale), -13);
  if (low > high) return high;
  return low > 0 ? low : (high < 0 ? high : 0);
}

}  // namespace rgs
