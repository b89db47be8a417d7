// turbo_lists.cu - sorts runs of entries by tile: a thread a tile, then a thread a run.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  counts [tiles], runs -> lists [tiles], ranked, tile_runs; long_lists and their slices, bins set to 0; cells of
//         empty tiles
// Cost    16 B read, 16 B gathered and 8 B written anywhere a run; of a long list, 8 B read of the first and every 64th
//         entry of each run
// Launch  plan: 256 threads, ceil(tiles / 256) blocks and one more; place: as many blocks of 256 as the device holds at a
//         time, which take runs in turn, because their number is known on the device alone
// Order   of runs within a list, of lists and of tiles within a class: any
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "turbo/place_cells.cuh"
#include "turbo/read_list.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

// Whether the front end's output fitted.
__device__ bool turbo_fits(const TurboArrays& a) {
  const TurboState& state = *a.state;
  return state.counters.instances <= a.entry_capacity && state.runs <= a.run_capacity &&
         state.n_large_gaussians <= a.large_capacity;
}

// Adds a long list and returns its index.
__device__ std::uint32_t add_long(const TurboArrays& a, std::uint32_t tile, std::uint32_t in_class, std::uint32_t n,
                                  std::uint32_t n_runs) {
  const std::uint32_t own = atomicAdd(&a.state->n_long_lists, 1u);
  TurboLongList list{};
  list.tile = tile;
  list.in_class = in_class;
  list.n_entries = n;
  list.scratch = atomicAdd(&a.state->n_scratch, n);
  const std::uint32_t slice = turbo_slice(a.state->counters.instances, n);
  list.n_slices = math::max((n + slice - 1) / slice, (n_runs + kTurboSliceRuns - 1) / kTurboSliceRuns);
  list.first_slice = atomicAdd(&a.state->n_slices, list.n_slices);
  list.nearest = ~0u;
  a.long_lists[own] = list;
  for (std::uint32_t k = 0; k < list.n_slices; ++k) a.slices[list.first_slice + k] = own;
  return own;
}

// Extends a list's depth range by a run's first and every 64th entry.
__device__ void add_sample(const TurboArrays& a, TurboRun run, TurboLongList& list) {
  const int dropped = a.state->dropped;
  std::uint32_t nearest = ~0u, farthest = 0;
  for (std::uint32_t k = 0; k < run.n; k += 64) {
    const std::uint32_t depth = depth_of(a.entries[run.begin + k], dropped);
    nearest = math::min(nearest, depth), farthest = math::max(farthest, depth);
  }
  // Mostly in range already: avoids atomics on one word, which serialise.
  if (nearest < *static_cast<volatile std::uint32_t*>(&list.nearest)) atomicMin(&list.nearest, nearest);
  if (farthest > *static_cast<volatile std::uint32_t*>(&list.farthest)) atomicMax(&list.farthest, farthest);
}

__global__ void __launch_bounds__(kThreads) plan_kernel(TurboArrays a, TurboState* seen) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  __shared__ std::uint32_t base, class_size[kTurboClasses], class_base[kTurboClasses];
  if (threadIdx.x < kTurboClasses) class_size[threadIdx.x] = 0;
  TurboState& state = *a.state;
  if (blockIdx.x == gridDim.x - 1) {  // a block of its own: the copy to the host takes longest
    if (threadIdx.x == 0) {
      *seen = state;
      __threadfence_system();
    }
    return;
  }
  const bool fits = turbo_fits(a);
  const auto* const counts = reinterpret_cast<const TurboCount*>(a.state + 1);
  const std::uint32_t tile = blockIdx.x * kThreads + threadIdx.x;
  const TurboCount count = tile < a.n_tiles && fits ? counts[tile] : 0;
  const auto n = static_cast<std::uint32_t>(count), runs = static_cast<std::uint32_t>(count >> 32);
  const std::uint32_t end = inclusive_block_sum<kThreads>(runs, warp_sums);
  if (threadIdx.x == kThreads - 1) base = atomicAdd(&state.n_placed, end);
  const int own_class = turbo_class(n);
  const std::uint32_t in_block = tile < a.n_tiles ? atomicAdd(class_size + own_class, 1u) : 0;
  __syncthreads();
  if (threadIdx.x < kTurboClasses) {
    class_base[threadIdx.x] = atomicAdd(state.class_size + threadIdx.x, class_size[threadIdx.x]);
  }
  if (threadIdx.x == 0) atomicAdd(&state.n_ordered, class_size[kTurboClasses - 1]);
  __syncthreads();
  if (tile >= a.n_tiles) return;
  const std::uint32_t in_class = class_base[own_class] + in_block;
  a.lists[tile] = {base + end - runs, runs, n, n >= kTurboRound ? add_long(a, tile, in_class, n, runs) : in_class};
}

__global__ void __launch_bounds__(kThreads) place_kernel(TurboArrays a, math::TileGrid grid) {
  const TurboState& state = *a.state;
  const std::uint32_t first = blockIdx.x * kThreads + threadIdx.x, step = gridDim.x * kThreads;
  const std::uint32_t class_begin = own_class_begin(a);
  for (std::uint32_t tile = first; tile - threadIdx.x % 32 < a.n_tiles; tile += step) {
    const TurboList list = tile < a.n_tiles ? a.lists[tile] : TurboList{};
    const bool is_long = list.n_entries >= kTurboRound;
    const std::uint32_t rank =
        rank_of(class_begin, list.n_entries, is_long ? a.long_lists[list.number].in_class : list.number);
    if (tile >= a.n_tiles) break;
    a.ranked[rank] = {list.begin, list.n_runs, list.n_entries, tile};
    if (list.n_entries > 0) continue;
    for (std::uint32_t c = 0; c < kTurboCells; ++c) write_cell(a, grid, rank, tile, c, 0, 0);
  }
  if (!turbo_fits(a)) return;
  const std::uint64_t n = state.runs;
  for (std::uint64_t k = first; k < n; k += step) {
    const TurboTileRun run = a.runs[k];
    const TurboList list = a.lists[run.tile];
    a.tile_runs[list.begin + run.in_tile] = run.run;
    if (list.n_entries >= kTurboRound) add_sample(a, run.run, a.long_lists[list.number]);
  }
  auto* const bins = reinterpret_cast<uint4*>(a.bins);
  for (std::uint64_t k = first; k < state.n_long_lists * std::uint64_t{kTurboBins / 4}; k += step)
    bins[k] = {0, 0, 0, 0};
}

}  // namespace

Status launch_turbo_lists(const TurboArrays& a, math::TileGrid grid, TurboState* seen, Stream stream) {
  plan_kernel<<<blocks_for(a.n_tiles, kThreads) + 1, kThreads, 0, stream>>>(a, seen);
  if (const auto ok = launched("the kernel that plans the lists could not be launched"); !ok) return ok;
  const auto blocks = resident_grid<place_kernel>(kThreads);
  if (!blocks) return tl::unexpected(blocks.error());
  place_kernel<<<*blocks, kThreads, 0, stream>>>(a, grid);
  return launched("the kernel that fills the lists could not be launched");
}

}  // namespace rgs::cuda
