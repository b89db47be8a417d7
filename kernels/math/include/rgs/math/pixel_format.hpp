// pixel_format.hpp - colour and alpha of a pixel packed into one word, for displays and encoders.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>

#include "rgs/hd.hpp"
#include "rgs/math/vec.hpp"
#include "rgs/quantize.hpp"

namespace rgs::math {

/// A packed pixel: red, green, blue, alpha in the order of addresses. The colour is blended over the background
/// (premultiplied if that is black) and display-referred as 3DGS trains it: the values are sRGB-encoded already, and no
/// transfer curve is applied. alpha = 1 - T.
enum class PixelFormat : std::uint8_t {
  rgba8,    ///< 4 bytes, round(255 clamp(v, 0, 1)) each; NaN becomes 0
  rgba16f,  ///< 4 FP16 numbers, 8 bytes, rounded to nearest, not clamped; overflow becomes infinite
};

RGS_HD constexpr std::uint64_t pixel_bytes(PixelFormat format) {
  return format == PixelFormat::rgba8 ? 4 : 8;
}

/// round(255 clamp(v, 0, 1)), ties to even; 0 for NaN.
RGS_HD inline std::uint32_t unorm8(float v) {
  // 1.5 * 2^23 leaves no bits for a fraction: one fused step multiplies, rounds once, and leaves the integer in the
  // last byte, the same on every machine.
  return rgs::detail::bits_of(std::fma(clamp(v, 0.0F, 1.0F), 255.0F, 12582912.0F)) & 0xFFu;
}

/// The 8-bit code of a value in a file or an array of pictures: round(255 clamp(v, 0, 1)), halves up; 0 for NaN.
RGS_HD inline std::uint8_t code8(float value) {
  if (!(value > 0)) return 0;
#if defined(__CUDA_ARCH__)
  const float scaled = __fadd_rn(__fmul_rn(value, 255.0F), 0.5F);  // not contracted, as on the CPU
#else
  const float scaled = value * 255.0F + 0.5F;
#endif
  return static_cast<std::uint8_t>(value >= 1 ? 255.0F : scaled);
}

RGS_HD inline std::uint32_t pack_rgba8(const Vec3<float>& color, float alpha) {
  return unorm8(color.x) | unorm8(color.y) << 8 | unorm8(color.z) << 16 | unorm8(alpha) << 24;
}

RGS_HD inline std::uint64_t pack_rgba16f(const Vec3<float>& color, float alpha) {
  return static_cast<std::uint64_t>(half_from_float(color.x)) |
         static_cast<std::uint64_t>(half_from_float(color.y)) << 16 |
         static_cast<std::uint64_t>(half_from_float(color.z)) << 32 |
         static_cast<std::uint64_t>(half_from_float(alpha)) << 48;
}

}  // namespace rgs::math
