// device_memory.hpp - allocates device memory: by the caller's functions, or from a pool of our own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>

#include "cuda/cuda_objects.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

class DevicePool;

/// Memory of the device current at create(). As thread-safe as the caller's functions.
class DeviceMemory {
 public:
  /// Errors: bad_argument (one function without the other), device_failed.
  static Result<std::shared_ptr<const DeviceMemory>> create(const DeviceAllocator& allocator);

  /// `bytes` > 0 for work queued on `stream` from now on. Errors: device_out_of_memory with the bytes in
  /// Error::expected, device_failed.
  Result<void*> allocate(std::uint64_t bytes, CudaStream stream) const;
  /// The device no longer uses the memory.
  void free(void* memory, std::uint64_t bytes) const;

 private:
  DeviceAllocator allocator_;
  std::shared_ptr<const DevicePool> pool_;  // null and no allocator: cudaMalloc(), if the driver has no pools
};

/// How many more workspaces of `bytes` fit into half of the current device's free memory; 0 if that is unknown.
std::size_t room_for(std::uint64_t bytes);

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

  /// At least `bytes`, for work queued on `stream` from now on; growing loses the contents. The device must not use the
  /// buffer then, nor when it is destroyed. Errors: those of DeviceMemory::allocate(), which leave the buffer empty.
  Status reserve(std::uint64_t bytes, const std::shared_ptr<const DeviceMemory>& memory, CudaStream stream) {
    if (bytes <= bytes_) return {};
    *this = {};  // first, since both may not fit
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
