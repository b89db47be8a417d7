// blend_pixel.cuh - a thread's pixels of its tile, and the sum of their counts.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/atomic_add.cuh"
#include "sorted/blend.hpp"

namespace rgs::cuda {

inline constexpr int kTilePixels = math::kTileSize * math::kTileSize;

/// N vertically adjacent pixels of the block's tile, (x, y) the first, tile-local. A warp has 8 columns and 4 N rows:
/// the squarer, the fewer Gaussians touch it.
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
