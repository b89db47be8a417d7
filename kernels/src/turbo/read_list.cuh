// read_list.cuh - reads a tile's list: its entries, their depths, how many touch each cell.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/block_scan.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {

struct TurboRuns {
  const TurboRun* runs;
  const TurboEntry* entries;
  std::uint32_t n_runs;

  /// Shared memory of for_each().
  template <int Threads>
  struct Places {
    std::uint32_t run_begin[Threads];  // first entry of each run less its place among the runs' entries
    std::uint32_t run_end[Threads];    // inclusive sums of their sizes
    // Aligned, or ptxas reads them together with the word before, which other threads write.
    alignas(16) std::uint32_t warp_sums[Threads / 32];
  };

  /// Calls f(entry, position) for every entry, with four loads a thread in flight. All threads of the block call it.
  template <int Threads, class F>
  __device__ void for_each(Places<Threads>& s, const F& f) const {
    constexpr int kAhead = 4;
    const std::uint32_t lane = threadIdx.x % 32, below = (1u << lane) - 1;
    std::uint32_t done = 0;
    for (std::uint32_t begin = 0; begin < n_runs; begin += Threads) {
      const TurboRun run = begin + threadIdx.x < n_runs ? runs[begin + threadIdx.x] : TurboRun{0, 0};
      const std::uint32_t run_end = inclusive_block_sum<Threads>(run.n, s.warp_sums);
      s.run_end[threadIdx.x] = run_end;
      s.run_begin[threadIdx.x] = run.begin - (run_end - run.n);
      __syncthreads();
      const std::uint32_t n = s.run_end[Threads - 1];
      // A warp reads neighbouring groups of 32.
      const std::uint32_t each = 32 * ((n + Threads - 1) / Threads), from = threadIdx.x / 32 * each;
      const std::uint32_t to = math::min(from + each, n);
      std::uint32_t owner = from < to ? owner_of<Threads>(s.run_end, from) : 0;  // run of the group's first entry
      for (std::uint32_t first = from; first < to; first += 32 * kAhead) {
        TurboEntry loaded[kAhead];
#pragma unroll
        for (std::uint32_t j = 0; j < kAhead; ++j) {
          const std::uint32_t group = first + 32 * j, k = group + lane;
          if (group >= to) break;
          // Bit b: a run ends with the group's entry b.
          const std::uint32_t last = s.run_end[math::min(owner + lane, std::uint32_t{Threads - 1})] - 1 - group;
          const std::uint32_t ends = warp_or(last < 32 ? 1u << last : 0);
          const std::uint32_t own = owner + static_cast<std::uint32_t>(__popc(static_cast<int>(ends & below)));
          if (k < to) loaded[j] = entries[s.run_begin[own] + k];
          owner += static_cast<std::uint32_t>(__popc(static_cast<int>(ends)));
        }
#pragma unroll
        for (std::uint32_t j = 0; j < kAhead; ++j) {
          const std::uint32_t k = first + 32 * j + lane;
          if (k < to) f(loaded[j], done + k);
        }
      }
      done += n;
      __syncthreads();
    }
  }
};

/// Counts, over the block, how many entries touch each cell. An entry's bits are added to 16-bit counters, four to a
/// word, which are flushed before one can overflow.
class CellCounter {
 public:
  /// `sums` [kTurboCells] in shared memory, zeroed before.
  __device__ explicit CellCounter(std::uint32_t* sums) : sums_(sums) {}
  __device__ void add(TurboEntry entry) {
    constexpr std::uint64_t kSpread = detail::bits_at(0, kBits - 1, kCounters), kMask = (1 << kCounters) - 1;
    constexpr std::uint64_t kLowest = detail::bits_at(0, kBits, kCounters);
    low_ += (entry & kMask) * kSpread & kLowest;
    if constexpr (kTurboCells > kCounters) high_ += (entry >> kCounters & kMask) * kSpread & kLowest;
    if (++n_ < kMost) return;
    for (int c = 0; c < kTurboCells; ++c) atomicAdd(sums_ + c, of(c));
    low_ = high_ = 0, n_ = 0;
  }
  /// All lanes of a warp call it at the end.
  __device__ void flush() const {
    for (int c = 0; c < kTurboCells; ++c) {
      const std::uint32_t sum = warp_sum(of(c));
      if (threadIdx.x % 32 == 0) atomicAdd(sums_ + c, sum);
    }
  }

 private:
  static constexpr int kBits = 16, kCounters = 64 / kBits;
  static constexpr std::uint32_t kMost = (1u << kBits) - 1;
  static_assert(kTurboCells <= 2 * kCounters);

  __device__ std::uint32_t of(int cell) const {
    return static_cast<std::uint32_t>((cell < kCounters ? low_ : high_) >> (kBits * (cell % kCounters))) & kMost;
  }

  std::uint32_t* sums_;
  std::uint64_t low_ = 0, high_ = 0;
  std::uint32_t n_ = 0;
};

}  // namespace rgs::cuda
