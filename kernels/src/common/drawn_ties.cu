// drawn_ties.cu - the tie order of what a frame draws of a scene with levels of detail: that of all rows, without the others.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  chunks, order and rank of all rows [n] -> order and rank of the drawn rows
// Cost    a drawn row: 4 B of its rank read, a bit set in L2, 4 B of the order gathered, 8 B written, 4 of them scattered; a
//         row of the scene: 3 bits cleared or read. Expected bound: L2
// Launch  256 threads: one a drawn row that there is room for; then blocks of kBlockWords words of bits, twice
// Shared  sums of warps
// Order   deterministic: bits, and sums of integers
//
// A bit a row, in the order of ranks, says what is drawn; how many bits come before one is its rank among them. So that the work
// grows with what is drawn, and but a bit each with what is not; a filter of the order itself would read 4 B of every row and
// gather its chunk's place.
#include <cuda_runtime.h>

#include <cstdint>

#include "common/block_scan.cuh"
#include "common/cut.hpp"
#include "common/drawn_rows.cuh"
#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kTurns = 4;  // a thread looks at four words in each
constexpr std::uint32_t kTurnWords = 4 * kThreads, kBlockWords = kTurns * kTurnWords;

__global__ void __launch_bounds__(kThreads) mark_kernel(DrawnTiesArguments a) {
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= n_drawn_rows(a.drawn, a.chunk_size)) return;
  const std::uint32_t rank = __ldg(a.all.rank + drawn_row(a.drawn, a.chunk_size, i));
  atomicOr(a.bits + rank / 32, 1u << rank % 32);
}

__device__ uint4 load_words(const DrawnTiesArguments& a, std::uint32_t turn) {
  const std::uint64_t first = std::uint64_t{blockIdx.x} * kBlockWords + turn * kTurnWords;
  return reinterpret_cast<const uint4*>(a.bits + first)[threadIdx.x];
}
__device__ std::uint32_t count(const uint4& w) {
  return static_cast<std::uint32_t>(__popc(static_cast<int>(w.x)) + __popc(static_cast<int>(w.y)) +
                                    __popc(static_cast<int>(w.z)) + __popc(static_cast<int>(w.w)));
}

// In every thread.
__device__ std::uint32_t block_sum(std::uint32_t value) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  __syncthreads();
  const std::uint32_t sum = warp_sum(value);
  if (threadIdx.x % 32 == 0) warp_sums[threadIdx.x / 32] = sum;
  __syncthreads();
  std::uint32_t total = 0;
#pragma unroll
  for (int w = 0; w < kThreads / 32; ++w) total += warp_sums[w];
  return total;
}

__global__ void __launch_bounds__(kThreads) count_kernel(DrawnTiesArguments a) {
  std::uint32_t n = 0;
#pragma unroll
  for (std::uint32_t turn = 0; turn < kTurns; ++turn) n += count(load_words(a, turn));
  n = block_sum(n);
  if (threadIdx.x == 0) a.sums[blockIdx.x] = n;
}

__global__ void __launch_bounds__(kThreads) write_kernel(DrawnTiesArguments a) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  std::uint32_t before = 0;
  for (std::uint32_t b = threadIdx.x; b < blockIdx.x; b += kThreads) before += a.sums[b];
  std::uint32_t base = block_sum(before);
  for (std::uint32_t turn = 0; turn < kTurns; ++turn) {
    const uint4 loaded = load_words(a, turn);
    const std::uint32_t n = count(loaded), end = inclusive_block_sum<kThreads>(n, warp_sums);
    std::uint32_t place = base + end - n;
    const std::uint32_t first_rank =
        32 * (blockIdx.x * kBlockWords + turn * kTurnWords + 4 * threadIdx.x);  // all ranks are below 2^31
    const std::uint32_t words[4] = {loaded.x, loaded.y, loaded.z, loaded.w};
#pragma unroll
    for (std::uint32_t k = 0; k < 4; ++k) {
      for (std::uint32_t left = words[k]; left != 0; left &= left - 1) {
        const auto bit = static_cast<std::uint32_t>(__ffs(static_cast<int>(left)) - 1);
        const std::uint32_t row = __ldg(a.all.order + first_rank + 32 * k + bit), chunk = row / a.chunk_size;
        if (a.rank == nullptr) {
          a.order[place++] = row;
          continue;
        }
        const std::uint32_t drawn = a.places[chunk] * a.chunk_size + (row - chunk * a.chunk_size);
        a.order[place] = drawn;
        a.rank[drawn] = place++;
      }
    }
    base += block_sum(n);
  }
}

}  // namespace

std::uint32_t drawn_ties_blocks(std::uint32_t n_rows) {
  return blocks_for((std::uint64_t{n_rows} + 31) / 32, kBlockWords);
}
std::uint64_t drawn_ties_words(std::uint32_t n_rows) {
  return std::uint64_t{drawn_ties_blocks(n_rows)} * kBlockWords;
}

Status launch_drawn_ties(const DrawnTiesArguments& a, Stream stream) {
  Status ok = checked(cudaMemsetAsync(a.bits, 0, drawn_ties_words(a.n_rows) * sizeof(std::uint32_t), stream),
                      "the bits of drawn rows could not be cleared");
  if (!ok) return ok;
  mark_kernel<<<blocks_for(std::uint64_t{a.drawn.capacity} * a.chunk_size, kThreads), kThreads, 0, stream>>>(a);
  if (ok = launched("drawn rows could not be marked"); !ok) return ok;
  const std::uint32_t blocks = drawn_ties_blocks(a.n_rows);
  count_kernel<<<blocks, kThreads, 0, stream>>>(a);
  if (ok = launched("drawn rows could not be counted"); !ok) return ok;
  write_kernel<<<blocks, kThreads, 0, stream>>>(a);
  return launched("drawn rows could not be put in tie order");
}

}  // namespace rgs::cuda
