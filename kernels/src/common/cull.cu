// cull.cu - keeps the chosen chunks that are in view; a thread a chunk.
// SPDX-License-Identifier: Apache-2.0
//
// Math    common/cull_chunk.cuh
// In/Out  chosen [n], CHNK -> chunks [in view], counts
// Cost    36 B a chosen chunk, gathered, twice; 4 B written a chunk in view
// Launch  256 threads, a block for 256 chunks of the scene; blocks beyond the chosen chunks end at once. Twice: count, write
// Shared  sums of warps
// Order   deterministic: chunks keep their order
//
// Chunks out of view take no drawn rows.
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/cull_chunk.cuh"
#include "common/cut.hpp"
#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

__device__ bool is_listed(const CullArguments& a, const CullPlanes& planes, std::uint32_t i, std::uint32_t n) {
  return i < n && (!a.by_view || chunk_in_view(a.entries, a.chosen[i], a.view.view, planes));
}

__global__ void __launch_bounds__(kThreads)
    count_kernel(const __grid_constant__ CullArguments a, const __grid_constant__ CullPlanes planes) {
  const std::uint32_t n = a.counts->chunks, first = blockIdx.x * kThreads;
  if (first >= n) return;
  const int listed = __syncthreads_count(is_listed(a, planes, first + threadIdx.x, n));
  if (threadIdx.x == 0) a.sums[blockIdx.x] = static_cast<std::uint32_t>(listed);
}

__global__ void __launch_bounds__(kThreads)
    write_kernel(const __grid_constant__ CullArguments a, const __grid_constant__ CullPlanes planes) {
  __shared__ std::uint32_t sums_before[kThreads / 32], warp_sums[kThreads / 32];
  const std::uint32_t n = a.counts->chunks, first = blockIdx.x * kThreads;
  if (first >= n && first > 0) return;  // the first block writes the counts, also of no chunk
  std::uint32_t before = 0;
  for (std::uint32_t b = threadIdx.x; b < blockIdx.x; b += kThreads) before += a.sums[b];
  before = warp_sum(before);
  if (threadIdx.x % 32 == 0) sums_before[threadIdx.x / 32] = before;
  const bool listed = is_listed(a, planes, first + threadIdx.x, n);
  // After its barrier all threads see the sums.
  std::uint32_t end = inclusive_block_sum<kThreads>(listed ? 1 : 0, warp_sums);
#pragma unroll
  for (const std::uint32_t sum : sums_before) end += sum;
  if (listed && end <= a.capacity) a.chunks[end - 1] = a.chosen[first + threadIdx.x];
  if (n - first <= kThreads && threadIdx.x == kThreads - 1) {
    const CutCounts all{a.counts->gaussians, a.counts->pages, end, a.counts->detail_px, 0};
    *a.listed = all;
    *a.seen = all;
    __threadfence_system();
  }
}

}  // namespace

std::uint32_t cull_blocks(std::uint32_t n_chunks) {
  return blocks_for(n_chunks, kThreads);
}

Status launch_cull(const CullArguments& a, Stream stream) {
  const CullPlanes planes = cull_planes(a.view);
  const std::uint32_t blocks = cull_blocks(a.n_chunks);
  count_kernel<<<blocks, kThreads, 0, stream>>>(a, planes);
  if (const auto ok = launched("the chunks in view could not be counted"); !ok) return ok;
  write_kernel<<<blocks, kThreads, 0, stream>>>(a, planes);
  return launched("the chunks in view could not be listed");
}

}  // namespace rgs::cuda
