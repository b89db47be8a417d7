// turbo_lists.cu - runs of entries to the tiles that they belong to: a thread a tile, then a thread a run.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  counts [tiles], runs -> lists [tiles], tile_runs, classes
// Cost    16 B read, 16 B gathered and 8 B written anywhere a run
// Launch  plan: 256 threads, ceil(tiles / 256) blocks and one more; place: as many blocks of 256 as keep the device busy, each
//         taking runs in turn, because their number is known on the device alone
// Order   of runs within a list, of lists and of tiles within a class: any
#include <cstdint>

#include "block_scan.cuh"
#include "launch.cuh"
#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kPlaceBlocks = 132 * 8;

// Whether the front end could write all that it had.
__device__ bool turbo_fits(const TurboArrays& a) {
  const TurboState& state = *a.state;
  return state.counters.instances <= a.entry_capacity && state.runs <= a.run_capacity &&
         state.n_large <= a.large_capacity;
}

__global__ void __launch_bounds__(kThreads) plan_kernel(TurboArrays a, TurboState* seen) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  __shared__ std::uint32_t base, class_size[kTurboClasses], class_base[kTurboClasses];
  if (threadIdx.x < kTurboClasses) class_size[threadIdx.x] = 0;
  TurboState& state = *a.state;
  if (blockIdx.x == gridDim.x - 1) {  // a block of its own: what goes to the host takes longest
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
  if (threadIdx.x == kThreads - 1) base = atomicAdd(&state.placed, end);
  const int length = turbo_class(n);
  const std::uint32_t rank = tile < a.n_tiles ? atomicAdd(class_size + length, 1u) : 0;
  __syncthreads();
  if (threadIdx.x < kTurboClasses) {
    class_base[threadIdx.x] = atomicAdd(state.class_size + threadIdx.x, class_size[threadIdx.x]);
  }
  __syncthreads();
  if (tile >= a.n_tiles) return;
  a.lists[tile] = {base + end - runs, runs, n, n > kTurboEntries ? atomicAdd(&state.scratch, n) : 0};
  a.classes[static_cast<std::uint32_t>(length) * a.n_tiles + class_base[length] + rank] = tile;
}

__global__ void __launch_bounds__(kThreads) place_kernel(TurboArrays a) {
  const TurboState& state = *a.state;
  if (!turbo_fits(a)) return;
  const std::uint64_t n = state.runs;
  for (std::uint64_t k = blockIdx.x * kThreads + threadIdx.x; k < n; k += gridDim.x * kThreads) {
    const TurboTileRun run = a.runs[k];
    a.tile_runs[a.lists[run.tile].begin + run.rank] = run.run;
  }
}

}  // namespace

Status launch_turbo_lists(const TurboArrays& a, TurboState* seen, CUevent_st* counted, Stream stream) {
  plan_kernel<<<blocks_for(a.n_tiles, kThreads) + 1, kThreads, 0, stream>>>(a, seen);
  if (const auto ok = launched("the kernel that plans the lists could not be launched"); !ok) return ok;
  if (const auto ok = checked(cudaEventRecord(counted, stream), "an event could not be recorded"); !ok) return ok;
  place_kernel<<<kPlaceBlocks, kThreads, 0, stream>>>(a);
  return launched("the kernel that fills the lists could not be launched");
}

}  // namespace rgs::cuda
