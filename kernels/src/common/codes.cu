// codes.cu - 8-bit codes of a picture's values; one thread a value.
// SPDX-License-Identifier: Apache-2.0
//
// Math    math::code8()
// In/Out  values [n] -> codes [n]
// Cost    4 B read and 1 B written a value: expected bound, memory
// Launch  256 threads
// Order   deterministic. Compiled without contraction to FMA, so that codes equal the CPU's
#include "common/codes.hpp"
#include "common/launch.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) codes_kernel(const float* values, std::uint64_t n, std::uint8_t* codes) {
  const std::uint64_t i = std::uint64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i < n) codes[i] = math::code8(values[i]);
}

}  // namespace

Status launch_codes(const float* values, std::uint64_t n, std::uint8_t* codes, Stream stream) {
  codes_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(values, n, codes);
  return launched("a picture's codes could not be computed");
}

}  // namespace rgs::cuda
