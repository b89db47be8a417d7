// drawn_ties.cu - the tie order of a frame's drawn rows, filtered from that of all rows of a scene with levels of
// detail.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  chunks, order and rank of all rows [n] -> order and rank of the drawn rows
// Cost    a drawn row: 4 B of its rank read, a bit set in L2, 4 B of the order gathered, 8 B written, 4 of them scattered; a
//         row of the scene: a bit cleared, and read twice. Expected bound: L2
// Launch  256 threads, one for each drawn row that fits; then a block for kBlockWords words of bits, twice
// Shared  sums of warps; the set bits of 256 words, 16 KiB, so that threads process one after the other
// Order   deterministic: bits, and integer sums
//
// A bitmap in rank order marks drawn rows; the number of bits before one is its rank among them. So the work grows with
// the drawn rows, plus a bit for each other row; filtering the order itself would read 4 B of every row and gather its
// chunk.
#include <cuda_runtime.h>

#include <cstdint>

#include "common/block_scan.cuh"
#include "common/cut.hpp"
#include "common/drawn_rows.cuh"
#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kTurns = 4;  // of a block; a word a thread each
constexpr std::uint32_t kBlockWords = kTurns * kThreads;

__global__ void __launch_bounds__(kThreads) mark_kernel(DrawnTiesArguments a) {
  const std::uint32_t i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= n_drawn_rows(a.drawn, a.chunk_size)) return;
  const std::uint32_t rank = __ldg(a.all.rank + drawn_row(a.drawn, a.chunk_size, i));
  atomicOr(a.bits + rank / 32, 1u << rank % 32);
}

__device__ std::uint32_t count(std::uint32_t word) {
  return static_cast<std::uint32_t>(__popc(static_cast<int>(word)));
}

// Returned in every thread.
__device__ std::uint32_t block_sum(std::uint32_t value) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  const std::uint32_t sum = warp_sum(value);
  if (threadIdx.x % 32 == 0) warp_sums[threadIdx.x / 32] = sum;
  __syncthreads();
  std::uint32_t total = 0;
#pragma unroll
  for (int w = 0; w < kThreads / 32; ++w) total += warp_sums[w];
  return total;
}

__global__ void __launch_bounds__(kThreads) count_kernel(DrawnTiesArguments a) {
  static_assert(kBlockWords == 4 * kThreads);
  const uint4 w = reinterpret_cast<const uint4*>(a.bits + std::uint64_t{blockIdx.x} * kBlockWords)[threadIdx.x];
  const std::uint32_t n = block_sum(count(w.x) + count(w.y) + count(w.z) + count(w.w));
  if (threadIdx.x == 0) a.sums[blockIdx.x] = n;
}

__global__ void __launch_bounds__(kThreads) write_kernel(DrawnTiesArguments a) {
  __shared__ std::uint32_t warp_sums[kThreads / 32];
  __shared__ std::uint16_t set[32 * kThreads];  // set bits of a turn
  static_assert(32 * kThreads <= 1 << 16);
  std::uint32_t before = 0;
  for (std::uint32_t b = threadIdx.x; b < blockIdx.x; b += kThreads) before += a.sums[b];
  std::uint32_t base = block_sum(before);
  for (std::uint32_t turn = 0; turn < kTurns; ++turn) {
    const std::uint32_t first_word = blockIdx.x * kBlockWords + turn * kThreads;
    std::uint32_t left = a.bits[first_word + threadIdx.x];
    std::uint32_t place = inclusive_block_sum<kThreads>(count(left), warp_sums) - count(left);
    for (; left != 0; left &= left - 1) {
      const auto bit = static_cast<std::uint32_t>(__ffs(static_cast<int>(left)) - 1);
      set[place++] = static_cast<std::uint16_t>(32 * threadIdx.x + bit);
    }
    __syncthreads();
    std::uint32_t n = 0;
#pragma unroll
    for (const std::uint32_t sum : warp_sums) n += sum;
    for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) {
      const std::uint32_t row = __ldg(a.all.order + 32 * first_word + set[k]);  // ranks are below 2^31
      if (a.rank == nullptr) {
        a.order[base + k] = row;
        continue;
      }
      const std::uint32_t chunk = row / a.chunk_size;
      const std::uint32_t drawn = a.places[chunk] * a.chunk_size + (row - chunk * a.chunk_size);
      a.order[base + k] = drawn;
      a.rank[drawn] = base + k;
    }
    base += n;
    __syncthreads();
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
