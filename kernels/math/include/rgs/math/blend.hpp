// blend.hpp - depth keys, a pair's opacity, and front-to-back compositing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "rgs/hd.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/vec.hpp"

namespace rgs::math {

// ---- depth order -----------------------------------------------------------------------------------------------

/// Bits of a tile's number: ceil(log2 n_tiles). The rest of a 32-bit key is depth (the paper, III-A2).
RGS_HD constexpr int tile_bits(std::uint32_t n_tiles) {
  int bits = 0;
  while (bits < 32 && (std::uint64_t{1} << bits) < n_tiles) ++bits;
  return bits;
}

/// Fewest bits of quantised depth in a 32-bit key; with fewer, at 7680x4320, bins of a linear range are so wide that
/// Gaussians visibly swap.
inline constexpr int kMinDepthBits = 16;

/// Layout of a (tile, depth) key: tile above, depth below.
struct KeyLayout {
  int tile_bits;
  int depth_bits;
  bool quantized;  ///< false: depth_bits is 32 and holds the bits of FP32 z
  RGS_HD constexpr int bits() const { return tile_bits + depth_bits; }
};

/// `requested` bits of depth, 0 for all that the tile leaves of 32 (the paper, III-A2). If that is fewer than
/// kMinDepthBits the order is exact instead.
RGS_HD constexpr KeyLayout key_layout(DepthOrder order, int requested, std::uint32_t n_tiles) {
  const int tile = tile_bits(n_tiles);
  const int depth = requested > 0 ? requested : 32 - tile;
  if (order == DepthOrder::exact || (requested == 0 && depth < kMinDepthBits)) return {tile, 32, false};
  return {tile, depth, true};
}

/// Parameters of the quantised depth, eq. depth_quant of the paper; `logarithmic` replaces z by its logarithm.
struct DepthQuantizer {
  float origin;  ///< near, or its logarithm
  float scale;   ///< bins per unit
  float last;    ///< the last bin, rounded down to FP32
  DepthMapping mapping;
};

/// 1 <= bits <= 32, 0 < near < far.
RGS_HD inline DepthQuantizer make_depth_quantizer(DepthMapping mapping, int bits, float near_depth, float far_depth) {
  const bool is_log = mapping == DepthMapping::logarithmic;
  const double low = is_log ? std::log(static_cast<double>(near_depth)) : static_cast<double>(near_depth);
  const double high = is_log ? std::log(static_cast<double>(far_depth)) : static_cast<double>(far_depth);
  const double bins = static_cast<double>((std::uint64_t{1} << bits) - 1);
  // Above 24 bits the number of bins is not an FP32 value; the largest value below keeps the conversion in range.
  const double last = bits <= 24 ? bins : bins + 1 - static_cast<double>(std::uint64_t{1} << (bits - 24));
  return {static_cast<float>(low), static_cast<float>(bins / (high - low)), static_cast<float>(last), mapping};
}

/// Bin of a depth, monotone in z; depths outside the range share the end bins.
RGS_HD inline std::uint32_t quantize_depth(const DepthQuantizer& q, float z) {
  const float t = q.mapping == DepthMapping::logarithmic ? std::log(z) : z;
  return static_cast<std::uint32_t>(clamp((t - q.origin) * q.scale, 0.0F, q.last));
}

/// Key of the exact order: positive floats sort as their bits.
RGS_HD inline std::uint32_t depth_bits(float z) {
  std::uint32_t bits;
  std::memcpy(&bits, &z, sizeof bits);
  return bits;
}

// ---- exponentials ----------------------------------------------------------------------------------------------

/// 2^p for -126 < p < 128 from the bits of p (Schraudolph 1999; the paper, eq. fma_exp): the integer and fractional
/// part of p become exponent and mantissa, which replaces 2^f by 1 + f; `sigma` centres the error.
RGS_HD inline float exp2_bits(float p, float sigma) {
  const float scaled = p * 8388608.0F + 8388608.0F * (127.0F - sigma);
  const auto bits = static_cast<std::uint32_t>(scaled);  // positive: truncation is floor
  float result;
  std::memcpy(&result, &bits, sizeof result);
  return result;
}

/// Bias of an exponent for negative_exp2().
RGS_HD constexpr float exp2_bias(float sigma) {
  return 255.0F - sigma;
}
/// -exp2_bits(p, sigma) in one shift, from the biased exponent p + exp2_bias(sigma): the sum's exponent field is that
/// of 2^7, so its mantissa is the result's exponent and mantissa without the last seven bits (relative error 2^-16),
/// and the field's lowest bits become the sign. Avoids a conversion, which runs at a quarter of the rate. For biased
/// exponents in [128, 256), i.e. -126 < p < 1.
RGS_HD inline float negative_exp2(float biased) {
  std::uint32_t bits;
  std::memcpy(&bits, &biased, sizeof bits);
  bits <<= 7;
  float result;
  std::memcpy(&result, &bits, sizeof result);
  return result;
}
/// The biased exponent at which negative_exp2() is -kAlphaMax: clamps the opacity on the exponent, which also keeps it
/// in range. Its last bit is rounded up, so that a second such Gaussian ends the pixel, as with kAlphaMax itself: 0.01
/// * 0.01 in FP32 is below kTransmittanceMin.
inline constexpr float kBiasedAlphaMax = 254.98001F;

template <Exp E>
RGS_HD constexpr float exp_sigma() {
  return E == Exp::paper ? kSigmaPaper : kSigmaZeroMean;
}

// ---- opacity of a (pixel, Gaussian) pair -----------------------------------------------------------------------

/// Exponent of the Gaussian at an offset from its mean, natural base: -(a dx^2 + 2 b dx dy + c dy^2) / 2.
template <class T>
RGS_HD inline T power(const Conic<T>& q, T dx, T dy) {
  return T(-0.5) * (q.a * dx * dx + q.c * dy * dy) - q.b * dx * dy;
}

/// Opacity of a pair, or 0 if it is skipped: exponent rounded above 0, or alpha < 1/255. `cutoff` is
/// power_cutoff(opacity); the approximations test it before the exponential, so they change opacities but never which
/// pairs count. The exact one tests alpha, as the original does.
template <Exp E, class T>
RGS_HD inline T alpha_direct(T p, T opacity, T cutoff) {
  if (p > T(0)) return T(0);
  if constexpr (E == Exp::exact) {
    const T alpha = min(T(kAlphaMax), opacity * std::exp(p));
    return alpha < T(kAlphaMin) ? T(0) : alpha;
  } else {
    if (p < cutoff) return T(0);
    return min(T(kAlphaMax), opacity * exp2_bits(p * kLog2E, exp_sigma<E>()));
  }
}

/// Coefficients of log2(opacity * exp(power)) in pixel coordinates relative to a tile's first pixel (the paper, eq.
/// coeff, times log2(e)). With absolute coordinates, x^2 = 3840^2 would cancel in FP32.
template <class T>
struct Folded {
  T xx, xy, yy, x, y, one;
};

/// `mean` is relative to the tile's first pixel; log2_opacity = log2(opacity).
template <class T>
RGS_HD inline Folded<T> fold(const Conic<T>& q, const PixelPoint<T>& mean, T log2_opacity) {
  const T a = T(kLog2E) * q.a, b = T(kLog2E) * q.b, c = T(kLog2E) * q.c;
  // The constant is the exponent at the tile's first pixel, factored so that needles cancel once instead of twice.
  const T x = a * mean.u + b * mean.v, y = c * mean.v + b * mean.u;
  return {T(-0.5) * a, -b, T(-0.5) * c, x, y, log2_opacity - T(0.5) * (x * mean.u + y * mean.v)};
}

/// Folded exponent, base 2, at tile-local pixel (x, y): three fused steps in x once the terms of y are hoisted.
template <class T>
RGS_HD inline T folded_exponent(const Folded<T>& f, T x, T y) {
  const T linear = std::fma(f.xy, y, f.x);
  const T constant = std::fma(std::fma(f.yy, y, f.y), y, f.one);
  return std::fma(std::fma(f.xx, x, linear), x, constant);
}

/// Exponent at (x, y + 1) from the one at (x, y): the dual-pixel step (the paper, eq. dual_pixel).
template <class T>
RGS_HD inline T folded_exponent_below(const Folded<T>& f, T exponent, T x, T y) {
  return exponent + std::fma(f.xy, x, std::fma(f.yy, T(2) * y + T(1), f.y));
}

/// Opacity of a pair from its folded exponent, or 0 if it is skipped: exponent below log2(1/255). Rounding may raise
/// the exponent above log2(opacity), even above 0; the clamp comes after.
template <Exp E, class T>
RGS_HD inline T alpha_folded(T exponent) {
  if (!(exponent >= T(kLog2AlphaMin))) return T(0);
  if constexpr (E == Exp::exact) {
    return min(T(kAlphaMax), std::exp2(exponent));
  } else {
    return min(T(kAlphaMax), exp2_bits(min(exponent, 1.0F), exp_sigma<E>()));
  }
}

// ---- compositing -----------------------------------------------------------------------------------------------

/// Sums of a pixel, front to back.
template <class T>
struct Pixel {
  T r = 0, g = 0, b = 0;
  T depth = 0;  ///< sum of weight * z
  T transmittance = 1;
};

/// Blends one Gaussian (alpha > 0) with weight alpha * T (Kerbl et al. 2023, eq. 3). False if the transmittance would
/// fall below 1e-4: then nothing is blended and the pixel is finished.
template <class T>
RGS_HD inline bool blend(Pixel<T>& pixel, T alpha, const Vec3<T>& color, T z) {
  const T next = pixel.transmittance * (T(1) - alpha);
  if (next < T(kTransmittanceMin)) return false;
  const T weight = alpha * pixel.transmittance;
  pixel.r += weight * color.x;
  pixel.g += weight * color.y;
  pixel.b += weight * color.z;
  pixel.depth += weight * z;
  pixel.transmittance = next;
  return true;
}

/// Colour over a background.
template <class T>
RGS_HD inline Vec3<T> resolve(const Pixel<T>& pixel, const Vec3<T>& background) {
  const T t = pixel.transmittance;
  return {pixel.r + t * background.x, pixel.g + t * background.y, pixel.b + t * background.z};
}

/// Mean depth of a pixel; 0 if nothing was blended.
template <class T>
RGS_HD inline T expected_depth(const Pixel<T>& pixel) {
  const T alpha = T(1) - pixel.transmittance;
  return alpha > T(0) ? pixel.depth / alpha : T(0);
}

}  // namespace rgs::math
