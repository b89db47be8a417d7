// copy_pieces.cu - copies pieces of page-locked memory to the device; a block a piece.
// SPDX-License-Identifier: Apache-2.0
//
// Many threads upload pages, and their driver calls wait for each other. A launch takes a thread 10 us; copying as many
// pieces by the driver, even with one call, 60 to 120 us (docs/records/EXPERIMENTS.md).
//
// Math    none
// In/Out  n pieces of host memory -> the device's, 16 bytes at a time
// Cost    each byte once over PCIe and once to memory: expected bound, the latency of PCIe
// Launch  n blocks of 256 threads, each with four reads in flight
// Order   deterministic
#include "common/copy_pieces.hpp"
#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

constexpr std::uint32_t kThreads = 256, kAtOnce = 4;

__global__ void __launch_bounds__(kThreads) copy_pieces_kernel(const __grid_constant__ Pieces pieces) {
  const auto* const from = static_cast<const uint4*>(pieces.from[blockIdx.x]);
  auto* const to = static_cast<uint4*>(pieces.to[blockIdx.x]);
  const std::uint32_t n = pieces.bytes[blockIdx.x] / sizeof(uint4);
  for (std::uint32_t first = threadIdx.x; first < n; first += kThreads * kAtOnce) {
    uint4 some[kAtOnce];
#pragma unroll
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      if (first + k * kThreads < n) some[k] = from[first + k * kThreads];
    }
#pragma unroll
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      if (first + k * kThreads < n) to[first + k * kThreads] = some[k];
    }
  }
}

}  // namespace

Status launch_copy_pieces(const Pieces& pieces, Stream stream) {
  copy_pieces_kernel<<<pieces.n, kThreads, 0, stream>>>(pieces);
  return launched("pages could not be copied to the device");
}

}  // namespace rgs::cuda
