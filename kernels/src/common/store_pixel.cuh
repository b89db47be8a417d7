// store_pixel.cuh - how a finished pixel leaves a blending kernel: the one epilogue of all of them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_fp16.h>

#include <cstdint>

#include "common/frame.hpp"

namespace rgs::cuda {

template <class T>
__device__ inline T* row_of(T* data, std::uint64_t pitch, int y) {
  return reinterpret_cast<T*>(reinterpret_cast<char*>(data) + static_cast<std::uint64_t>(y) * pitch);
}

/// One store as wide as the pixel. Lanes of a warp are neighbours in rows of at least eight pixels, which fill sectors
/// of 32 bytes, so that wider stores by fewer lanes would move the same. Format and surface are the same for all threads:
/// a branch at the end of a pixel's loop costs less than kernels for each. What would lie beside a surface is dropped.
template <class Word>
__device__ inline void store_word(const PixelArrays& t, int x, int y, Word word) {
  if (t.surface != 0) {
    surf2Dwrite(word, t.surface, x * static_cast<int>(sizeof(Word)), y, cudaBoundaryModeZero);
  } else {
    row_of(static_cast<Word*>(t.packed), t.pitch.packed, y)[x] = word;
  }
}
__device__ inline void store_packed(const PixelArrays& t, int x, int y, const math::Vec3<float>& color, float alpha) {
  if (t.format == math::PixelFormat::rgba8) {
    store_word(t, x, y, math::pack_rgba8(color, alpha));
  } else {  // math::pack_rgba16f() by the instruction for it
    const __half2 low = __floats2half2_rn(color.x, color.y), high = __floats2half2_rn(color.z, alpha);
    store_word(
        t, x, y,
        make_uint2(*reinterpret_cast<const std::uint32_t*>(&low), *reinterpret_cast<const std::uint32_t*>(&high)));
  }
}

/// Writes pixel (x, y) of every output that is wanted. `Details`: also depth and counts.
template <bool Details>
__device__ inline void store_pixel(const PixelArrays& t, const math::Vec3<float>& background, int x, int y,
                                   const math::Pixel<float>& pixel, std::uint32_t n_evaluated,
                                   std::uint32_t n_blended) {
  const auto color = math::resolve(pixel, background);
  const float alpha = 1 - pixel.transmittance;
  if (t.rgb != nullptr) {
    float* const to = row_of(t.rgb, t.pitch.rgb, y) + 3 * x;
    to[0] = color.x, to[1] = color.y, to[2] = color.z;
  }
  if (t.packed != nullptr || t.surface != 0) store_packed(t, x, y, color, alpha);
  if (t.alpha != nullptr) row_of(t.alpha, t.pitch.alpha, y)[x] = alpha;
  if constexpr (Details) {
    if (t.depth != nullptr) row_of(t.depth, t.pitch.depth, y)[x] = math::expected_depth(pixel);
    if (t.evaluated != nullptr) row_of(t.evaluated, t.pitch.evaluated, y)[x] = n_evaluated;
    if (t.blended != nullptr) row_of(t.blended, t.pitch.blended, y)[x] = n_blended;
  }
}

}  // namespace rgs::cuda
