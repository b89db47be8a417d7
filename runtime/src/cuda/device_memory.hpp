// device_memory.hpp - where device memory comes from: the caller's functions, or a pool of our own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <utility>

#include "cuda/cuda_objects.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

class DevicePool;

/// Memory of the device that was current at create(). Thread-safe as far as the caller's functions are.
class DeviceMemory {
 public:
  /// Errors: bad_argument (one function without the other), device_failed.
  static Result<std::shared_ptr<const DeviceMemory>> create(const DeviceAllocator& allocator);

  /// `bytes` > 0 for what is queued on `stream` from now on. Errors: device_out_of_memory with the bytes in
  /// Error::expected, device_failed.
  Result<void*> allocate(std::uint64_t bytes, CudaStream stream) const;
  /// Nothing on the device uses the memory any longer.
  void free(void* memory, std::uint64_t bytes) const;

 private:
  DeviceAllocator allocator_;
  std::shared_ptr<const DevicePool> pool_;  // neither: cudaMalloc(), where the driver has no pools
};

/// Owned device memory.
class DeviceBuffer {
 public:
  DeviceBuffer() = default;
  DeviceBuffer(DeviceBuffer&& other) noexcept
      : memory_(std::move(other.memory_)),
        data_(std::exchange(other.data_, nullptr)),
        bytes_(std::exchange(other.bytes_, 0)) {}
  DeviceBuffer& operator=(DeviceBuffer&& other) noexcept {
    std::swap(memory_, other.memory_);
    std::swap(data_, other.data_);
    std::swap(bytes_, other.bytes_);
    return *this;
  }
  ~DeviceBuffer() {
    if (data_ != nullptr) memory_->free(data_, bytes_);
  }

  /// At least `bytes`, for what is queued on `stream` from now on; contents are lost when it grows. Nothing on the device
  /// may use the buffer then, nor when it is destroyed. Errors: those of DeviceMemory::allocate() (the buffer is then
  /// empty).
  Status reserve(std::uint64_t bytes, const std::shared_ptr<const DeviceMemory>& memory, CudaStream stream) {
    if (bytes <= bytes_) return {};
    *this = {};  // first: both may not fit
    const auto data = memory->allocate(bytes, stream);
    if (!data) return tl::unexpected(data.error());
    memory_ = memory, data_ = *data, bytes_ = bytes;
    return {};
  }

  std::uint64_t bytes() const { return bytes_; }
  template <class T>
  T* as() const {
    return static_cast<T*>(data_);
  }

 private:
  std::shared_ptr<const DeviceMemory> memory_;
  void* data_ = nullptr;
  std::uint64_t bytes_ = 0;
};

}  // namespace rgs::detail
