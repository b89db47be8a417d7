// device_buffer.hpp - owned device memory, and errors of the CUDA runtime as values.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>
#include <utility>

#include "rgs/result.hpp"

namespace rgs::detail {

/// device_failed with the runtime's error number in Error::found. The runtime forgets the error: it is none of later calls.
inline Status device_status(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();
  return make_error(Errc::device_failed, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}

class DeviceBuffer {
 public:
  DeviceBuffer() = default;
  DeviceBuffer(DeviceBuffer&& other) noexcept
      : data_(std::exchange(other.data_, nullptr)), bytes_(std::exchange(other.bytes_, 0)) {}
  DeviceBuffer& operator=(DeviceBuffer&& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(bytes_, other.bytes_);
    return *this;
  }
  ~DeviceBuffer() { cudaFree(data_); }

  /// At least `bytes`; contents are lost when it grows. Errors: device_out_of_memory with the bytes in Error::expected
  /// (the buffer is then empty).
  Status reserve(std::uint64_t bytes) {
    if (bytes <= bytes_) return {};
    cudaFree(data_);  // first: both may not fit; waits for kernels that still read it
    data_ = nullptr, bytes_ = 0;
    const cudaError_t error = cudaMalloc(&data_, bytes);
    if (error != cudaSuccess) {
      data_ = nullptr;
      cudaGetLastError();  // it is no error of later calls
      if (error != cudaErrorMemoryAllocation) return device_status(error, "device memory cannot be allocated");
      return make_error(Errc::device_out_of_memory, Error::kNone, "the device has not this much memory left", bytes);
    }
    bytes_ = bytes;
    return {};
  }

  std::uint64_t bytes() const { return bytes_; }
  template <class T>
  T* as() const {
    return static_cast<T*>(data_);
  }

 private:
  void* data_ = nullptr;
  std::uint64_t bytes_ = 0;
};

}  // namespace rgs::detail
