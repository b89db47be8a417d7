// launch.cuh - checks a launch.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime.h>

#include "rgs/result.hpp"

namespace rgs::cuda {

inline Status checked(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();  // it is none of later calls
  return make_error(Errc::device_failed, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}
inline Status launched(const char* what) {
  return checked(cudaGetLastError(), what);
}
/// Blocks that are to share a multiprocessor, for __launch_bounds__: fewer where it has room for 1,024 threads, on sm_75.
constexpr int resident_blocks(int wanted, int threads) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
  return wanted * threads <= 1024 ? wanted : 1024 / threads;
#else
  return static_cast<void>(threads), wanted;
#endif
}
constexpr std::uint32_t blocks_for(std::uint64_t n, std::uint32_t threads) {
  return static_cast<std::uint32_t>((n + threads - 1) / threads);
}

}  // namespace rgs::cuda
