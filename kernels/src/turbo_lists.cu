// turbo_lists.cu - runs of entries to the tiles that they belong to, and the large Gaussians' entries with them.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/coverage.hpp
// In/Out  entries and runs of each tile, runs, large -> lists [tiles], tile_runs, classes, entries
// Cost    16 B read, 16 B gathered and 8 B written anywhere a run; an atomic addition and 8 B written anywhere an entry of
//         a large Gaussian
// Launch  plan: 256 threads, ceil(tiles / 256) blocks; place: as many blocks of 256 as keep the device busy, some with a
//         thread a row of a large Gaussian's part, the others with a thread a run, each taking them in turn, because
//         their number is known on the device alone
// Order   of runs within a list, of large Gaussians' entries within a run, of lists and of tiles within a class: any.
//         Compiled without contraction to FMA, so that placing meets the tiles that were counted.
#include <cstdint>

#include "block_scan.cuh"
#include "large_tiles.cuh"
#include "launch.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kLargeBlocks = 132 * 4, kRunBlocks = 132 * 2;

// Whether the front end could write all that it had.
__device__ bool turbo_fits(const TurboArrays& a) {
  const TurboState& state = *a.state;
  return state.counters.instances + state.large_entries <= a.entry_capacity && state.runs <= a.run_capacity &&
         state.n_large <= a.large_capacity;
}

// Two classes for each power of two from 2^5; 0 is the longest, the last holds the short and the empty.
__device__ int length_class(std::uint32_t length) {
  if (length < 32) return kTurboClasses - 1;
  const int log2 = 31 - __clz(static_cast<int>(length));
  const int half = static_cast<int>(length >> (log2 - 1)) & 1;
  return math::max(0, kTurboClasses - 2 - (2 * (log2 - 5) + half));
}

__global__ void __launch_bounds__(kThreads) plan_kernel(TurboArrays a, TurboState* seen) {
  __shared__ std::uint32_t warp_sums[2][kThreads / 32];
  __shared__ std::uint32_t run_base, large_base, class_size[kTurboClasses], class_base[kTurboClasses];
  if (threadIdx.x < kTurboClasses) class_size[threadIdx.x] = 0;
  TurboState& state = *a.state;
  const bool fits = turbo_fits(a);
  const TileCounts counts = TileCounts::of(a);
  const std::uint32_t tile = blockIdx.x * kThreads + threadIdx.x;
  const bool has_list = tile < a.n_tiles && fits;
  const std::uint64_t block = has_list ? counts.block[tile] : 0;
  const std::uint32_t n_large = has_list ? counts.large[tile] : 0;
  const std::uint32_t n = static_cast<std::uint32_t>(block) + n_large;
  const auto block_runs = static_cast<std::uint32_t>(block >> 32), runs = block_runs + (n_large > 0 ? 1 : 0);
  const std::uint32_t run_end = inclusive_block_sum<kThreads>(runs, warp_sums[0]);
  const std::uint32_t large_end = inclusive_block_sum<kThreads>(n_large, warp_sums[1]);
  if (threadIdx.x == kThreads - 1) {
    run_base = atomicAdd(&state.placed, run_end);
    large_base = static_cast<std::uint32_t>(state.counters.instances) + atomicAdd(&state.large_placed, large_end);
  }
  const int length = length_class(n);
  const std::uint32_t rank = tile < a.n_tiles ? atomicAdd(class_size + length, 1u) : 0;
  __syncthreads();
  if (threadIdx.x < kTurboClasses) {
    class_base[threadIdx.x] = atomicAdd(state.class_size + threadIdx.x, class_size[threadIdx.x]);
  }
  if (blockIdx.x == 0 && threadIdx.x == kTurboClasses) {
    *seen = state;
    seen->counters.instances = state.counters.instances + state.large_entries;
    __threadfence_system();
  }
  __syncthreads();
  if (tile >= a.n_tiles) return;
  const std::uint32_t first_run = run_base + run_end - runs, first_large = large_base + large_end - n_large;
  a.lists[tile] = {first_run, runs, n, n > kTurboEntries ? atomicAdd(&state.scratch, n) : 0};
  if (n_large > 0) a.tile_runs[first_run + block_runs] = {first_large, n_large};
  counts.large[tile] = first_large;
  a.classes[static_cast<std::uint32_t>(length) * a.n_tiles + class_base[length] + rank] = tile;
}

__device__ void place_large(const TurboArrays& a, math::TileGrid grid) {
  for_each_large_row<kThreads>(a, blockIdx.x, kLargeBlocks, [&](std::uint32_t at, std::uint32_t row, bool valid) {
    if (!valid || row >= a.large[at].n_rows) return;
    const TurboLarge part = a.large[at];
    for_each_large_tiles(part, row, grid, [&](std::uint32_t tile, const std::uint32_t(&cells)[4]) {
      std::uint32_t* const next = TileCounts::of(a).large + tile;
      std::uint32_t place[4];
#pragma unroll
      for (int k = 0; k < 4; ++k) place[k] = cells[k] != 0 ? atomicAdd(next + k, 1u) : 0;
#pragma unroll
      for (int k = 0; k < 4; ++k) {
        if (cells[k] != 0) a.entries[place[k]] = make_entry(part.depth, part.index, cells[k]);
      }
    });
  });
}

__device__ void place_runs(const TurboArrays& a) {
  const std::uint64_t n = a.state->runs;
  for (std::uint64_t k = (blockIdx.x - kLargeBlocks) * kThreads + threadIdx.x; k < n; k += kRunBlocks * kThreads) {
    const TurboTileRun run = a.runs[k];
    a.tile_runs[a.lists[run.tile].begin + run.rank] = run.run;
  }
}

__global__ void __launch_bounds__(kThreads) place_kernel(TurboArrays a, math::TileGrid grid) {
  if (!turbo_fits(a)) return;
  blockIdx.x < kLargeBlocks ? place_large(a, grid) : place_runs(a);
}

}  // namespace

Status launch_turbo_lists(const TurboArrays& a, math::TileGrid grid, TurboState* seen, CUevent_st* counted,
                          Stream stream) {
  plan_kernel<<<blocks_for(a.n_tiles, kThreads), kThreads, 0, stream>>>(a, seen);
  if (const auto ok = launched("the kernel that plans the lists could not be launched"); !ok) return ok;
  if (const auto ok = checked(cudaEventRecord(counted, stream), "an event could not be recorded"); !ok) return ok;
  place_kernel<<<kLargeBlocks + kRunBlocks, kThreads, 0, stream>>>(a, grid);
  return launched("the kernel that fills the lists could not be launched");
}

}  // namespace rgs::cuda
