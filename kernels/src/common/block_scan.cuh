// block_scan.cuh - sums over a block of threads.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::cuda {

inline constexpr std::uint32_t kFullWarp = 0xFFFFFFFFu;

__device__ inline std::uint32_t inclusive_warp_sum(std::uint32_t value) {
  const int lane = static_cast<int>(threadIdx.x % 32);
#pragma unroll
  for (int step = 1; step < 32; step *= 2) {
    const std::uint32_t below = __shfl_up_sync(kFullWarp, value, static_cast<unsigned>(step));
    if (lane >= step) value += below;
  }
  return value;
}

/// `value` of all lanes of the warp combined, in every lane.
template <class T, class Combine>
__device__ inline T reduce_warp(T value, const Combine& combine) {
#pragma unroll
  for (int step = 16; step > 0; step /= 2) value = combine(value, __shfl_xor_sync(kFullWarp, value, step));
  return value;
}
#if __CUDA_ARCH__ >= 800
__device__ inline std::uint32_t warp_sum(std::uint32_t value) {
  return __reduce_add_sync(kFullWarp, value);
}
__device__ inline std::uint32_t warp_min(std::uint32_t value) {
  return __reduce_min_sync(kFullWarp, value);
}
__device__ inline std::uint32_t warp_max(std::uint32_t value) {
  return __reduce_max_sync(kFullWarp, value);
}
__device__ inline std::uint32_t warp_or(std::uint32_t value) {
  return __reduce_or_sync(kFullWarp, value);
}
#else
__device__ inline std::uint32_t warp_sum(std::uint32_t value) {
  return reduce_warp(value, [](std::uint32_t a, std::uint32_t b) { return a + b; });
}
__device__ inline std::uint32_t warp_min(std::uint32_t value) {
  return reduce_warp(value, [](std::uint32_t a, std::uint32_t b) { return a < b ? a : b; });
}
__device__ inline std::uint32_t warp_max(std::uint32_t value) {
  return reduce_warp(value, [](std::uint32_t a, std::uint32_t b) { return a > b ? a : b; });
}
__device__ inline std::uint32_t warp_or(std::uint32_t value) {
  return reduce_warp(value, [](std::uint32_t a, std::uint32_t b) { return a | b; });
}
#endif

/// Inclusive sum over the block's threads; `warp_sums` holds one word a warp. Two calls that share `warp_sums` need a
/// barrier in between.
template <int Threads>
__device__ inline std::uint32_t inclusive_block_sum(std::uint32_t value, std::uint32_t* warp_sums) {
  static_assert(Threads % 32 == 0 && Threads <= 1024);
  const std::uint32_t inclusive = inclusive_warp_sum(value);
  if (threadIdx.x % 32 == 31) warp_sums[threadIdx.x / 32] = inclusive;
  __syncthreads();
  std::uint32_t before = 0;
#pragma unroll
  for (int warp = 0; warp < Threads / 32; ++warp)
    before += warp < static_cast<int>(threadIdx.x / 32) ? warp_sums[warp] : 0;
  return before + inclusive;
}

/// First index whose inclusive sum exceeds `item`: the owner of item `item`. Size is a power of two.
template <int Size, class Sum>
__device__ inline std::uint32_t owner_of(const Sum* inclusive_sums, std::uint32_t item) {
  std::uint32_t at = 0;
#pragma unroll
  for (std::uint32_t step = Size / 2; step > 0; step /= 2) {
    if (inclusive_sums[at + step - 1] <= item) at += step;
  }
  return at;
}

}  // namespace rgs::cuda
