// launch.cuh - checks a launch.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime.h>

#include "rgs/result.hpp"

namespace rgs::cuda {

inline Status checked(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return {};
  return fail(Errc::device_failed, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}
inline Status launched(const char* what) {
  return checked(cudaGetLastError(), what);
}
constexpr std::uint32_t blocks_for(std::uint64_t n, std::uint32_t threads) {
  return static_cast<std::uint32_t>((n + threads - 1) / threads);
}

}  // namespace rgs::cuda
