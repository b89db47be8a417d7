// store_pixel.cuh - how a finished pixel leaves a blending kernel: the one epilogue of all of them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_fp16.h>

#include <cstdint>

#include "common/frame.hpp"

namespace rgs::cuda {

/// One store as wide as the pixel. Lanes of a warp are neighbours in rows of at least eight pixels, which fill sectors
/// of 32 bytes, so that wider stores by fewer lanes would move the same. The format is the same for all threads: a branch
/// at the end of a pixel's loop costs less than kernels for each format.
__device__ inline void store_packed(const PixelArrays& t, std::size_t i, const math::Vec3<float>& color, float alpha) {
  if (t.format == math::PixelFormat::rgba8) {
    static_cast<std::uint32_t*>(t.packed)[i] = math::pack_rgba8(color, alpha);
  } else {  // math::pack_rgba16f() by the instruction for it
    const __half2 low = __floats2half2_rn(color.x, color.y), high = __floats2half2_rn(color.z, alpha);
    static_cast<uint2*>(t.packed)[i] =
        make_uint2(*reinterpret_cast<const std::uint32_t*>(&low), *reinterpret_cast<const std::uint32_t*>(&high));
  }
}

/// Writes pixel i of every output that is wanted. `Details`: also depth and counts.
template <bool Details>
__device__ inline void store_pixel(const PixelArrays& t, const math::Vec3<float>& background, std::size_t i,
                                   const math::Pixel<float>& pixel, std::uint32_t n_evaluated,
                                   std::uint32_t n_blended) {
  const auto color = math::resolve(pixel, background);
  const float alpha = 1 - pixel.transmittance;
  if (t.rgb != nullptr) t.rgb[3 * i] = color.x, t.rgb[3 * i + 1] = color.y, t.rgb[3 * i + 2] = color.z;
  if (t.packed != nullptr) store_packed(t, i, color, alpha);
  if (t.alpha != nullptr) t.alpha[i] = alpha;
  if constexpr (Details) {
    if (t.depth != nullptr) t.depth[i] = math::expected_depth(pixel);
    if (t.evaluated != nullptr) t.evaluated[i] = n_evaluated;
    if (t.blended != nullptr) t.blended[i] = n_blended;
  }
}

}  // namespace rgs::cuda
