// launch.cuh - how many blocks to launch, and whether the launch succeeded.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime.h>

#include <array>
#include <atomic>
#include <cstdint>

#include "rgs/result.hpp"

namespace rgs::cuda {

inline Status checked(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();  // later calls must not report it
  return make_error(Errc::device_failed, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}
inline Status launched(const char* what) {
  return checked(cudaGetLastError(), what);
}
/// Threads that a multiprocessor holds (CUDA C++ Programming Guide, "Technical Specifications per Compute Capability").
/// PTX carries the number of its own architecture; the driver ignores it if the device holds fewer.
constexpr int multiprocessor_threads() {
#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ == 800 || __CUDA_ARCH__ == 900 || \
    (__CUDA_ARCH__ >= 1000 && __CUDA_ARCH__ < 1100)
  return 2048;
#elif __CUDA_ARCH__ >= 800
  return 1536;  // 8.6, 8.7, 8.9, 11.x, 12.x, and architectures not known yet
#else
  return 1024;  // 7.5
#endif
}
/// Blocks to share a multiprocessor, for __launch_bounds__: fewer if it holds fewer threads.
constexpr int resident_blocks(int wanted, int threads) {
  return wanted * threads <= multiprocessor_threads() ? wanted : multiprocessor_threads() / threads;
}
/// `wanted` where ptxas spills registers if it chooses the number itself: on 8.0 to 8.9, and from PTX of 7.5. From 9.0
/// on 0, its own choice.
constexpr int resident_before_90([[maybe_unused]] int wanted) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 900
  return wanted;
#else
  return 0;
#endif
}
/// `wanted` on 9.0, where it was measured to be faster. Elsewhere 0, ptxas's choice.
constexpr int resident_on_90([[maybe_unused]] int wanted) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ == 900
  return wanted;
#else
  return 0;
#endif
}
constexpr std::uint32_t blocks_for(std::uint64_t n, std::uint32_t threads) {
  return static_cast<std::uint32_t>((n + threads - 1) / threads);
}

/// A property of each device, queried once. Thread-safe.
class DeviceNumber {
 public:
  /// Of the current device. `ask`: cudaError_t(int device, int& number). Errors: device_failed.
  template <class Ask>
  Result<std::uint32_t> get(const Ask& ask) {
    int device = 0, number = 0;
    cudaError_t error = cudaGetDevice(&device);
    const bool is_kept = error == cudaSuccess && device < kDevices;
    if (is_kept) number = known_[static_cast<std::size_t>(device)].load(std::memory_order_relaxed);
    if (error == cudaSuccess && number == 0) error = ask(device, number);
    if (const auto ok = checked(error, "a property of the device could not be read"); !ok) {
      return tl::unexpected(ok.error());
    }
    if (is_kept) known_[static_cast<std::size_t>(device)].store(number, std::memory_order_relaxed);
    return static_cast<std::uint32_t>(number);
  }

 private:
  static constexpr int kDevices = 64;  // further ones are queried every time
  std::array<std::atomic<int>, kDevices> known_{};
};

inline cudaError_t ask_multiprocessors(int device, int& number) {
  return cudaDeviceGetAttribute(&number, cudaDevAttrMultiProcessorCount, device);
}
/// Of the current device. Errors: device_failed.
inline Result<std::uint32_t> multiprocessors() {
  static DeviceNumber known;
  return known.get(ask_multiprocessors);
}
/// Number of blocks of kKernel, without dynamic shared memory, that the current device holds at once: for kernels that
/// learn the amount of work on the device and whose blocks take it in turn. Errors: device_failed.
template <auto kKernel>
Result<std::uint32_t> resident_grid(int threads) {
  static DeviceNumber known;
  return known.get([threads](int device, int& number) {
    int blocks = 0;
    cudaError_t error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kKernel, threads, 0);
    if (error == cudaSuccess) error = ask_multiprocessors(device, number);
    number *= blocks;
    return error;
  });
}

}  // namespace rgs::cuda
