// store_pixel.cuh - how a finished pixel leaves a blending kernel: the one epilogue of all of them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_fp16.h>

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "common/frame.hpp"

namespace rgs::cuda {

/// Where a pixel lies in rows of any pitch, or on a surface.
struct PitchedPixel {
  int x, y;
  template <class T>
  __device__ T* in(T* data, std::uint64_t pitch, int channels = 1) const {
    auto* const row = reinterpret_cast<char*>(data) + static_cast<std::uint64_t>(y) * pitch;
    return reinterpret_cast<T*>(row) + channels * x;
  }
};
/// Where it lies if rows follow each other and there is no surface: PixelArrays::is_tight().
struct TightPixel {
  std::size_t index;
  template <class T>
  __device__ T* in(T* data, std::uint64_t, std::size_t channels = 1) const {
    return data + channels * index;
  }
};

/// One store as wide as the pixel. Lanes of a warp are neighbours in rows of at least eight pixels, which fill sectors
/// of 32 bytes, so that wider stores by fewer lanes would move the same. Format and surface are the same for all threads:
/// a branch at the end of a pixel's loop costs less than kernels for each. What would lie beside a surface is dropped.
template <class Word>
__device__ inline void store_word(const PixelArrays& t, const PitchedPixel& at, Word word) {
  if (t.surface != 0) {
    surf2Dwrite(word, t.surface, at.x * static_cast<int>(sizeof(Word)), at.y, cudaBoundaryModeZero);
  } else {
    *at.in(static_cast<Word*>(t.packed), t.pitch.packed) = word;
  }
}
template <class Word>
__device__ inline void store_word(const PixelArrays& t, const TightPixel& at, Word word) {
  *at.in(static_cast<Word*>(t.packed), 0) = word;
}
template <class Place>
__device__ inline void store_packed(const PixelArrays& t, const Place& at, const math::Vec3<float>& color,
                                    float alpha) {
  if (t.format == math::PixelFormat::rgba8) {
    store_word(t, at, math::pack_rgba8(color, alpha));
  } else {  // math::pack_rgba16f() by the instruction for it
    const __half2 low = __floats2half2_rn(color.x, color.y), high = __floats2half2_rn(color.z, alpha);
    store_word(
        t, at,
        make_uint2(*reinterpret_cast<const std::uint32_t*>(&low), *reinterpret_cast<const std::uint32_t*>(&high)));
  }
}

/// Writes every output of a pixel that is wanted. `Details`: also depth and counts.
template <bool Details, class Place>
__device__ inline void store_pixel(const PixelArrays& t, const math::Vec3<float>& background, const Place& at,
                                   const math::Pixel<float>& pixel, std::uint32_t n_evaluated,
                                   std::uint32_t n_blended) {
  const auto color = math::resolve(pixel, background);
  const float alpha = 1 - pixel.transmittance;
  if (t.rgb != nullptr) {
    float* const to = at.in(t.rgb, t.pitch.rgb, 3);
    to[0] = color.x, to[1] = color.y, to[2] = color.z;
  }
  if (t.packed != nullptr || (std::is_same_v<Place, PitchedPixel> && t.surface != 0)) store_packed(t, at, color, alpha);
  if (t.alpha != nullptr) *at.in(t.alpha, t.pitch.alpha) = alpha;
  if constexpr (Details) {
    if (t.depth != nullptr) *at.in(t.depth, t.pitch.depth) = math::expected_depth(pixel);
    if (t.evaluated != nullptr) *at.in(t.evaluated, t.pitch.evaluated) = n_evaluated;
    if (t.blended != nullptr) *at.in(t.blended, t.pitch.blended) = n_blended;
  }
}

}  // namespace rgs::cuda
