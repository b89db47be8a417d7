// cut.cu - which pages a frame draws; a thread a page, which reads its own record and its parent's.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/footprint.hpp; docs/format/FORMAT.md "Error and cut"
// In/Out  pages [n] -> chunks [drawn], counts
// Cost    96 B a page, half of them its parent's, which neighbours share; twice, with a limit of Gaussians three times.
//         About 60 FP64 operations. 4 B written a drawn chunk
// Launch  256 threads, ceil(n / 256) blocks, twice: count, write. Before that with a limit: the same once, for what each
//         step of the detail changes, and a thread that takes the finest step that fits
// Shared  sums of warps; with a limit 1 KiB of changes
// Order   deterministic: chunks in the order of pages. Compiled without contraction to FMA: the host chooses the same pages
//
// A block sums the counts of all blocks before it, which costs less than another launch: a hundred million Gaussians
// have 200 blocks of pages.
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/cut.hpp"
#include "common/launch.cuh"
#include "rgs/footprint.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;

__device__ double footprint(const CutPage& page, const CutEye& eye) {
  return lod::pixel_footprint(page.low, page.high, eye.position, eye.focal_px, eye.z_near);
}

__device__ bool is_fine_enough(const CutPage& page, const CutEye& eye, float detail_px) {
  return lod::is_fine_enough(page.error, detail_px, footprint(page, eye));
}

__device__ float drawn_detail(const CutArguments& a) {
  return a.eye.max_gaussians == kNoLimit ? a.eye.detail_px : a.limit->detail_px;
}

// A page is drawn from the first step on at which it is fine enough, up to its parent's.
__global__ void __launch_bounds__(kThreads)
    changes_kernel(CutArguments a, const __grid_constant__ lod::DetailSteps steps) {
  __shared__ unsigned long long changes[lod::kDetailSteps];
  for (int k = threadIdx.x; k < lod::kDetailSteps; k += kThreads) changes[k] = 0;
  __syncthreads();
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  if (i < a.n_pages) {
    const CutPage page = a.pages[i];
    const int begin = lod::first_fine_step(steps, page.error, footprint(page, a.eye));
    int end = lod::kDetailSteps;
    if (page.parent != kNoCutPage) {
      const CutPage& parent = a.pages[page.parent];
      end = lod::first_fine_step(steps, parent.error, footprint(parent, a.eye));
    }
    if (begin < end) {
      atomicAdd(&changes[begin], page.n);
      if (end < lod::kDetailSteps) atomicAdd(&changes[end], 0ull - page.n);
    }
  }
  __syncthreads();
  for (int k = threadIdx.x; k < lod::kDetailSteps; k += kThreads) {
    if (changes[k] != 0) atomicAdd(&a.limit->changes[k], changes[k]);
  }
}

__global__ void detail_kernel(CutArguments a, const __grid_constant__ lod::DetailSteps steps) {
  __shared__ unsigned long long changes[lod::kDetailSteps];
  for (int k = threadIdx.x; k < lod::kDetailSteps; k += blockDim.x) changes[k] = a.limit->changes[k];
  __syncthreads();
  if (threadIdx.x != 0) return;
  const int root_step = lod::first_fine_step(steps, a.pages[0].error, footprint(a.pages[0], a.eye));
  unsigned long long gaussians = 0;
  a.limit->detail_px = steps.px[lod::finest_fitting_step(changes, root_step, a.eye.max_gaussians, gaussians)];
}

// Page i, or n = 0 if it is not drawn.
__device__ CutPage drawn_page(const CutArguments& a, float detail_px, std::uint32_t i) {
  CutPage page{};
  if (i >= a.n_pages) return page;
  page = a.pages[i];
  if (is_fine_enough(page, a.eye, detail_px) &&
      (page.parent == kNoCutPage || !is_fine_enough(a.pages[page.parent], a.eye, detail_px))) {
    return page;
  }
  return {};
}

__device__ std::uint64_t warp_sum_of(std::uint64_t value) {
  return reduce_warp(value, [](std::uint64_t x, std::uint64_t y) { return x + y; });
}

struct WarpCounts {
  CutCounts warps[kWarps];
};
// Over the block; the sum is valid in thread 0.
__device__ CutCounts block_counts(WarpCounts& s, const CutCounts& own) {
  const CutCounts sum{warp_sum_of(own.gaussians), warp_sum(own.pages), warp_sum(own.chunks), 0, 0};
  if (threadIdx.x % 32 == 0) s.warps[threadIdx.x / 32] = sum;
  __syncthreads();
  CutCounts total{};
  if (threadIdx.x == 0) {
    for (const CutCounts& w : s.warps) {
      total.gaussians += w.gaussians, total.pages += w.pages, total.chunks += w.chunks;
    }
  }
  return total;
}

__global__ void __launch_bounds__(kThreads) count_kernel(CutArguments a) {
  __shared__ WarpCounts s;
  const CutPage page = drawn_page(a, drawn_detail(a), blockIdx.x * kThreads + threadIdx.x);
  const CutCounts total = block_counts(s, {page.n, page.n > 0 ? 1u : 0u, page.n_chunks, 0, 0});
  if (threadIdx.x == 0) a.sums[blockIdx.x] = total;
}

__global__ void __launch_bounds__(kThreads) write_kernel(CutArguments a) {
  __shared__ WarpCounts s;
  __shared__ std::uint32_t warp_sums[kWarps];
  __shared__ std::uint32_t base;
  const float detail_px = drawn_detail(a);
  CutCounts before{};
  for (std::uint32_t b = threadIdx.x; b < blockIdx.x; b += kThreads) {
    const CutCounts sum = a.sums[b];
    before.gaussians += sum.gaussians, before.pages += sum.pages, before.chunks += sum.chunks;
  }
  before = block_counts(s, before);
  if (threadIdx.x == 0) {
    base = before.chunks;
    if (blockIdx.x == gridDim.x - 1) {
      const CutCounts own = a.sums[blockIdx.x];
      const CutCounts all{before.gaussians + own.gaussians, before.pages + own.pages, before.chunks + own.chunks,
                          detail_px, 0};
      *a.counts = all;
    }
  }
  const CutPage page = drawn_page(a, detail_px, blockIdx.x * kThreads + threadIdx.x);
  // After its barrier all threads see `base`.
  const std::uint32_t end = inclusive_block_sum<kThreads>(page.n_chunks, warp_sums);
  const std::uint32_t first = base + end - page.n_chunks;
  for (std::uint32_t k = 0; k < page.n_chunks; ++k) a.chunks[first + k] = page.first_chunk + k;
}

}  // namespace

std::uint32_t cut_blocks(std::uint32_t n_pages) {
  return blocks_for(n_pages, kThreads);
}

Status launch_cut(const CutArguments& a, Stream stream) {
  if (a.eye.max_gaussians != kNoLimit) {
    const lod::DetailSteps steps = lod::detail_steps(a.eye.detail_px);
    cudaMemsetAsync(a.limit, 0, sizeof(CutLimit), stream);
    changes_kernel<<<cut_blocks(a.n_pages), kThreads, 0, stream>>>(a, steps);
    if (const auto ok = launched("what details change could not be counted"); !ok) return ok;
    detail_kernel<<<1, lod::kDetailSteps, 0, stream>>>(a, steps);
    if (const auto ok = launched("the detail could not be chosen"); !ok) return ok;
  }
  count_kernel<<<cut_blocks(a.n_pages), kThreads, 0, stream>>>(a);
  if (const auto ok = launched("drawn pages could not be counted"); !ok) return ok;
  write_kernel<<<cut_blocks(a.n_pages), kThreads, 0, stream>>>(a);
  return launched("drawn pages could not be listed");
}

}  // namespace rgs::cuda
