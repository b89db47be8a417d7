// emit_runs.cuh - how blocks write their entries: contiguous for each tile, as one run a tile.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {

/// Shared memory of reserve_runs().
template <int Threads>
struct RunPlaces {
  std::uint32_t warp_sums[Threads / 32];
  std::uint64_t entry_base, run_base;
};

/// Reserves places for the block's `n` entries of the thread's tile, writes their run, and returns the offset of the
/// first. At most 2^16 - 1 entries a block. All threads of the block call it, with 0 if there are none, and pass a
/// barrier before the next call.
template <int Threads>
__device__ std::uint32_t reserve_runs(RunPlaces<Threads>& s, std::uint32_t n, std::uint32_t tile,
                                      const TurboArrays& out) {
  // Sums entries and runs in one word.
  const std::uint32_t end = inclusive_block_sum<Threads>(n | (n > 0 ? 1u << 16 : 0), s.warp_sums);
  if (threadIdx.x == Threads - 1 && end > 0) {
    s.entry_base = atomic_add(out.state->counters.instances, end & 0xFFFFu);
    s.run_base = atomic_add(out.state->runs, end >> 16);
  }
  __syncthreads();
  const std::uint32_t begin = static_cast<std::uint32_t>(s.entry_base) + (end & 0xFFFFu) - n;
  if (n > 0) {
    const TurboCount before = atomicAdd(reinterpret_cast<unsigned long long*>(out.state + 1) + tile, 1ull << 32 | n);
    const std::uint64_t run = s.run_base + (end >> 16) - 1;
    if (run < out.run_capacity) out.runs[run] = {{begin, n}, tile, static_cast<std::uint32_t>(before >> 32)};
  }
  return begin;
}

}  // namespace rgs::cuda
