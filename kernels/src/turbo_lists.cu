// turbo_lists.cu - pairs into the tiles' lists: one small kernel over the tiles, one over the pairs.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  list_length [tiles] -> list_begin [tiles + 1], tile_order [tiles]; pairs -> entries
// Cost    pairs: 16 B read in order, 8 B written anywhere in its list, all of it in L2 unless there are many millions
// Launch  plan: one block of 1,024; place: as many blocks of 256 as the device holds, each taking pairs in turn,
// because
//         their number is known on the device alone
// Order   tiles of similar length and entries within a list: any; the blending kernel orders entries
#include <cstdint>

#include "block_scan.cuh"
#include "launch.cuh"
#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kPlanThreads = 1024;
constexpr int kPlaceThreads = 256;
constexpr int kPlaceBlocks = 132 * 8;
constexpr int kClasses = 64;  // of list lengths, two for each power of two

// The longest lists are class 0: they start first, so that none is left running alone at the end.
__device__ int length_class(std::uint32_t length) {
  if (length == 0) return kClasses - 1;
  const int log2 = 31 - __clz(static_cast<int>(length));
  const int half = log2 > 0 ? static_cast<int>(length >> (log2 - 1)) & 1 : 0;
  return kClasses - 2 - math::min(2 * log2 + half, kClasses - 2);
}

__global__ void __launch_bounds__(kPlanThreads) plan_kernel(TurboListArguments a) {
  __shared__ std::uint32_t warp_sums[kPlanThreads / 32];
  __shared__ std::uint32_t class_begin[kClasses];
  const bool fits = a.counters->instances <= a.capacity;
  if (threadIdx.x < kClasses) class_begin[threadIdx.x] = 0;
  __syncthreads();

  std::uint32_t total = 0;
  for (std::uint32_t begin = 0; begin < a.n_tiles; begin += kPlanThreads) {
    const std::uint32_t tile = begin + threadIdx.x;
    const std::uint32_t length = tile < a.n_tiles && fits ? a.list_length[tile] : 0;
    const std::uint32_t end = total + inclusive_block_sum<kPlanThreads>(length, warp_sums);
    if (tile < a.n_tiles) {
      a.list_begin[tile] = end - length;
      atomicAdd(class_begin + length_class(length), 1u);
    }
    __syncthreads();
    for (const std::uint32_t sum : warp_sums) total += sum;
    __syncthreads();
  }
  if (threadIdx.x == 0) {
    a.list_begin[a.n_tiles] = total;
    *a.seen = *a.counters;
    __threadfence_system();
  }
  if (threadIdx.x < 32) {
    const std::uint32_t low = class_begin[threadIdx.x], high = class_begin[threadIdx.x + 32];
    const std::uint32_t low_end = inclusive_warp_sum(low);
    const std::uint32_t high_end = inclusive_warp_sum(high) + __shfl_sync(kFullWarp, low_end, 31);
    class_begin[threadIdx.x] = low_end - low;
    class_begin[threadIdx.x + 32] = high_end - high;
  }
  __syncthreads();
  for (std::uint32_t tile = threadIdx.x; tile < a.n_tiles; tile += kPlanThreads) {
    const std::uint32_t length = fits ? a.list_length[tile] : 0;
    a.tile_order[atomicAdd(class_begin + length_class(length), 1u)] = tile;
  }
}

__global__ void __launch_bounds__(kPlaceThreads) place_kernel(TurboListArguments a) {
  const std::uint64_t n = a.counters->instances;
  if (n > a.capacity) return;
  for (std::uint64_t k = blockIdx.x * kPlaceThreads + threadIdx.x; k < n; k += gridDim.x * kPlaceThreads) {
    const TurboPair pair = a.pairs[k];
    a.entries[a.list_begin[pair.tile] + pair.rank] = pair.entry;
  }
}

}  // namespace

Status launch_turbo_lists(const TurboListArguments& a, CUevent_st* counted, Stream stream) {
  plan_kernel<<<1, kPlanThreads, 0, stream>>>(a);
  if (const auto ok = launched("the kernel that plans the lists could not be launched"); !ok) return ok;
  if (const auto ok = checked(cudaEventRecord(counted, stream), "an event could not be recorded"); !ok) return ok;
  place_kernel<<<kPlaceBlocks, kPlaceThreads, 0, stream>>>(a);
  return launched("the kernel that fills the lists could not be launched");
}

}  // namespace rgs::cuda
