// atomic_add.cuh - atomic additions to the 64-bit counters of a frame.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::cuda {

/// Adds n to a counter in device or shared memory, atomically for all blocks, and returns its old value. CUDA's
/// overload takes unsigned long long, which std::uint64_t is not on every platform.
__device__ inline std::uint64_t atomic_add(std::uint64_t& counter, std::uint64_t n) {
  return atomicAdd(reinterpret_cast<unsigned long long*>(&counter), static_cast<unsigned long long>(n));
}

}  // namespace rgs::cuda
