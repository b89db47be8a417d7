// store_pixel.cuh - stores a finished pixel: the epilogue of all blending kernels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_fp16.h>

#include <cstddef>
#include <cstdint>

#include "common/frame.hpp"

namespace rgs::cuda {

/// A pixel's address in the output `data` with the given pitch.
struct PitchedPixel {
  int x, y;
  template <class T>
  __device__ T* in(const PixelArrays& t, T* data, std::uint64_t RowPitches::*pitch, int channels = 1) const {
    auto* const row = reinterpret_cast<char*>(data) + static_cast<std::uint64_t>(y) * (t.pitch.*pitch);
    return reinterpret_cast<T*>(row) + channels * x;
  }
};
struct TightPixel {
  std::size_t index;
  template <class T>
  __device__ T* in(const TightArrays&, T* data, std::uint64_t RowPitches::*, std::size_t channels = 1) const {
    return data + channels * index;
  }
};

/// One store as wide as the pixel. Lanes of a warp are neighbours in rows of at least eight pixels, which fill sectors
/// of 32 bytes, so wider stores by fewer lanes would move the same bytes. Format and surface are the same for all
/// threads: a branch at the end of a pixel's loop costs less than a kernel each. Pixels beyond a surface are dropped.
template <class Word>
__device__ inline void store_word(const PixelArrays& t, const PitchedPixel& at, Word word) {
  if (t.surface != 0) {
    surf2Dwrite(word, t.surface, at.x * static_cast<int>(sizeof(Word)), at.y, cudaBoundaryModeZero);
  } else {
    *at.in(t, static_cast<Word*>(t.packed), &RowPitches::packed) = word;
  }
}
template <class Word>
__device__ inline void store_word(const TightArrays& t, const TightPixel& at, Word word) {
  *at.in(t, static_cast<Word*>(t.packed), &RowPitches::packed) = word;
}
__device__ inline bool has_packed(const PixelArrays& t) {
  return t.packed != nullptr || t.surface != 0;
}
__device__ inline bool has_packed(const TightArrays& t) {
  return t.packed != nullptr;
}

template <class Arrays, class Place>
__device__ inline void store_packed(const Arrays& t, const Place& at, const math::Vec3<float>& color, float alpha) {
  if (t.format == math::PixelFormat::rgba8) {
    store_word(t, at, math::pack_rgba8(color, alpha));
  } else {  // math::pack_rgba16f() in one instruction
    const __half2 low = __floats2half2_rn(color.x, color.y), high = __floats2half2_rn(color.z, alpha);
    store_word(
        t, at,
        make_uint2(*reinterpret_cast<const std::uint32_t*>(&low), *reinterpret_cast<const std::uint32_t*>(&high)));
  }
}

/// Writes every wanted output of a pixel: PixelArrays at a PitchedPixel, TightArrays at a TightPixel. `Details`: also
/// depth and counts.
template <bool Details, class Arrays, class Place>
__device__ inline void store_pixel(const Arrays& t, const math::Vec3<float>& background, const Place& at,
                                   const math::Pixel<float>& pixel, std::uint32_t n_evaluated,
                                   std::uint32_t n_blended) {
  const auto color = math::resolve(pixel, background);
  const float alpha = 1 - pixel.transmittance;
  if (t.rgb != nullptr) {
    float* const to = at.in(t, t.rgb, &RowPitches::rgb, 3);
    to[0] = color.x, to[1] = color.y, to[2] = color.z;
  }
  if (has_packed(t)) store_packed(t, at, color, alpha);
  if (t.codes != nullptr) {
    std::uint8_t* const to = at.in(t, t.codes, &RowPitches::codes, 3);
    to[0] = math::code8(color.x), to[1] = math::code8(color.y), to[2] = math::code8(color.z);
  }
  if (t.alpha != nullptr) *at.in(t, t.alpha, &RowPitches::alpha) = alpha;
  if constexpr (Details) {
    if (t.depth != nullptr) *at.in(t, t.depth, &RowPitches::depth) = math::expected_depth(pixel);
    if (t.evaluated != nullptr) *at.in(t, t.evaluated, &RowPitches::evaluated) = n_evaluated;
    if (t.blended != nullptr) *at.in(t, t.blended, &RowPitches::blended) = n_blended;
  }
}

}  // namespace rgs::cuda
