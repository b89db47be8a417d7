// blend_pixel.cuh - which pixels a thread has, and how they leave the kernel.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "atomic_add.cuh"
#include "rgs/cuda/blend.hpp"

namespace rgs::cuda {

inline constexpr int kTilePixels = math::kTileSize * math::kTileSize;

/// N vertically adjacent pixels of the block's tile, (x, y) the first, tile-local. A warp has 8 columns and 4 N rows:
/// the squarer it is, the fewer Gaussians touch it.
template <int N>
struct TilePixel {
  int x, y;

  __device__ static TilePixel of_thread() {
    const int lane = static_cast<int>(threadIdx.x % 32), warp = static_cast<int>(threadIdx.x / 32);
    return {8 * (warp % 2) + lane % 8, N * (4 * (warp / 2) + lane / 8)};
  }
  __device__ int image_x() const { return static_cast<int>(blockIdx.x) * math::kTileSize + x; }
  __device__ int image_y(int k) const { return static_cast<int>(blockIdx.y) * math::kTileSize + y + k; }
  __device__ bool inside(int k, int width, int height) const { return image_x() < width && image_y(k) < height; }
  __device__ std::size_t index(int k, int width) const {
    return static_cast<std::size_t>(image_y(k)) * static_cast<std::size_t>(width) + static_cast<std::size_t>(image_x());
  }
};

template <bool Details>
__device__ inline void store_pixel(const BlendArguments& a, std::size_t i, const math::Pixel<float>& pixel,
                                   std::uint32_t n_evaluated, std::uint32_t n_blended) {
  const PixelArrays& t = a.target;
  if (t.rgb != nullptr) {
    const auto color = math::resolve(pixel, a.background);
    t.rgb[3 * i] = color.x, t.rgb[3 * i + 1] = color.y, t.rgb[3 * i + 2] = color.z;
  }
  if (t.alpha != nullptr) t.alpha[i] = 1 - pixel.transmittance;
  if constexpr (Details) {
    if (t.depth != nullptr) t.depth[i] = math::expected_depth(pixel);
    if (t.evaluated != nullptr) t.evaluated[i] = n_evaluated;
    if (t.blended != nullptr) t.blended[i] = n_blended;
  }
}

template <int N>
__device__ inline void count_pairs(Counters& counters, const std::uint32_t (&evaluated)[N],
                                   const std::uint32_t (&blended)[N]) {
  std::uint32_t e = 0, b = 0;
#pragma unroll
  for (int k = 0; k < N; ++k) e += evaluated[k], b += blended[k];
  std::uint64_t sums[2] = {e, b};
#pragma unroll
  for (int step = 16; step > 0; step /= 2) {
    sums[0] += __shfl_xor_sync(0xFFFFFFFFu, sums[0], step);
    sums[1] += __shfl_xor_sync(0xFFFFFFFFu, sums[1], step);
  }
  if (threadIdx.x % 32 == 0) {
    atomic_add(counters.evaluated, sums[0]);
    atomic_add(counters.blended, sums[1]);
  }
}

}  // namespace rgs::cuda
