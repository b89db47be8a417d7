// load_splat.cuh - loads attributes from device memory into registers, FP32 or dequantised.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "rgs/math/camera_models.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/quantize.hpp"

namespace rgs::cuda {

/// A Gaussian without its colour.
struct Geometry {
  math::Quaternion<float> rotation;
  math::Vec3<float> scale;
  float opacity;
};

__device__ inline math::Vec3<float> load_mean(const float* mean, std::uint32_t i) {
  const float* const from = mean + 3 * static_cast<std::uint64_t>(i);
  return {__ldg(from), __ldg(from + 1), __ldg(from + 2)};
}

__device__ inline Geometry load_geometry(const Fp32Attributes& a, std::uint32_t i) {
  const float4 q = __ldg(reinterpret_cast<const float4*>(a.rotation) + i);
  return {{q.x, q.y, q.z, q.w}, load_mean(a.scale, i), __ldg(a.opacity + i)};
}

__device__ inline Geometry unpack_geometry(const uint4& w, float scale_unit) {
  const auto low = [](std::uint32_t word) { return static_cast<std::uint16_t>(word & 0xFFFFu); };
  const auto high = [](std::uint32_t word) { return static_cast<std::uint16_t>(word >> 16); };
  const std::uint16_t codes[4] = {low(w.x), high(w.x), low(w.y), high(w.y)};
  float q[4];
  dequantize_rotation(codes, q);
  return {{q[0], q[1], q[2], q[3]},
          {float_from_half(low(w.z)) * scale_unit, float_from_half(high(w.z)) * scale_unit,
           float_from_half(low(w.w)) * scale_unit},
          float_from_half(high(w.w))};
}

__device__ inline Geometry load_geometry(const CompactAttributes& a, std::uint32_t i) {
  return unpack_geometry(__ldg(reinterpret_cast<const uint4*>(a.geometry) + i), a.scale_unit);
}

__device__ inline Geometry load_geometry(const PagedAttributes& a, std::uint32_t i) {
  const float scale_unit = __uint_as_float(__ldg(a.chunks + 12 * std::uint64_t{i / a.chunk_size} + 11));
  return unpack_geometry(__ldg(reinterpret_cast<const uint4*>(a.geometry) + i), scale_unit);
}

template <int Degree>
__device__ inline math::Vec3<float> load_color(const Fp32Attributes& a, std::uint32_t i,
                                               const math::ShBasis<float>& basis) {
  constexpr int kFloats = 3 * (Degree + 1) * (Degree + 1);
  alignas(16) float sh[(kFloats + 3) / 4 * 4];
  const float* from = a.sh + static_cast<std::uint64_t>(i) * kFloats;
  if constexpr (kFloats % 4 == 0) {
#pragma unroll
    for (int k = 0; k < kFloats; k += 4) {
      *reinterpret_cast<float4*>(sh + k) = __ldg(reinterpret_cast<const float4*>(from + k));
    }
  } else {
#pragma unroll
    for (int k = 0; k < kFloats; ++k) sh[k] = __ldg(from + k);
  }
  return math::sh_color<float>(Degree, basis, [&](int k) {
    return math::Vec3<float>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]};
  });
}

template <int Degree>
__device__ inline math::Vec3<float> load_color(const CompactAttributes& a, std::uint32_t i,
                                               const math::ShBasis<float>& basis) {
  constexpr int kCodes = 3 * (Degree + 1) * (Degree + 1);
  constexpr int kWords = (kCodes + 3) / 4;
  std::uint32_t words[kWords];
  const std::uint32_t* from = a.sh + static_cast<std::uint64_t>(i) * kWords;
  if constexpr (kWords % 4 == 0) {
#pragma unroll
    for (int k = 0; k < kWords; k += 4) {
      const uint4 w = __ldg(reinterpret_cast<const uint4*>(from + k));
      words[k] = w.x, words[k + 1] = w.y, words[k + 2] = w.z, words[k + 3] = w.w;
    }
  } else {
#pragma unroll
    for (int k = 0; k < kWords; ++k) words[k] = __ldg(from + k);
  }
  // Byte 32 of a CHNK entry: its step set.
  const std::uint32_t set = __ldg(a.chunks + 12 * (i / a.chunk_size) + 8);
  const float* steps = a.sh_steps + 12 * set;
  float step[Degree + 1][3];
#pragma unroll
  for (int d = 0; d <= Degree; ++d) {
#pragma unroll
    for (int c = 0; c < 3; ++c) step[d][c] = __ldg(steps + 3 * d + c);
  }
  // Puts a code's byte plus 128 last in 2^23's mantissa: two instructions, where a conversion runs at a quarter of the
  // rate.
  const auto code = [&](int k) {
    const std::uint32_t bits =
        __byte_perm(words[k / 4] ^ 0x80808080u, 0x4B000000u, 0x7440u | static_cast<std::uint32_t>(k % 4));
    return __uint_as_float(bits) - 8388736.0F;
  };
  return math::sh_color<float>(
      Degree, basis,
      [&](int k) {
        return math::Vec3<float>{code(3 * k), code(3 * k + 1), code(3 * k + 2)};
      },
      [&](int l) {
        return math::Vec3<float>{step[l][0], step[l][1], step[l][2]};
      });
}

/// Prefetches what color_of() reads.
__device__ inline void prefetch_color(const Fp32Attributes&, std::uint32_t) {}
__device__ inline void prefetch_color(const CompactAttributes& a, std::uint32_t i) {
  const std::uint32_t words = (3u * static_cast<std::uint32_t>((a.sh_degree + 1) * (a.sh_degree + 1)) + 3) / 4;
  asm volatile("prefetch.global.L2 [%0];" : : "l"(a.sh + static_cast<std::uint64_t>(i) * words));
}

/// Colour of Gaussian i as the view sees it. Coefficients above the evaluated degree get a basis of 0.
template <bool kAnyModel, class Attributes>
__device__ inline math::Vec3<float> color_of(const Attributes& a, std::uint32_t i, const math::View<float>& view,
                                             const math::Vec3<float>& mean, int degree) {
  const auto basis =
      math::sh_basis(degree, kAnyModel ? math::direction_by_model(view, mean) : math::view_direction(view, mean));
  switch (a.sh_degree) {
    case 0: return load_color<0>(a, i, basis);
    case 1: return load_color<1>(a, i, basis);
    case 2: return load_color<2>(a, i, basis);
    default: return load_color<3>(a, i, basis);
  }
}

}  // namespace rgs::cuda
