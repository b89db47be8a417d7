// device_memory.cpp - the pool that a device's renderers and scenes share, and its substitutes.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_memory.hpp"

#include <algorithm>
#include <map>
#include <mutex>
#include <new>
#include <set>

namespace rgs::detail {

/// A pool of our own, so that settings of the device's default pool and memory that others leave in it do not matter.
/// It keeps no unused memory: its release threshold is 0, and every free() is followed by a synchronisation, at which a
/// pool releases memory.
class DevicePool {
 public:
  DevicePool() = default;
  DevicePool(const DevicePool&) = delete;
  DevicePool& operator=(const DevicePool&) = delete;
  ~DevicePool() {
    if (pool_ != nullptr) cudaMemPoolDestroy(pool_);
  }

  /// The current device's pool, which lives while anyone holds it; null if the driver has no pools. Errors:
  /// device_failed.
  static Result<std::shared_ptr<const DevicePool>> shared() {
    static std::mutex mutex;
    static std::map<int, std::weak_ptr<const DevicePool>> pools;
    int device = 0, is_supported = 0;
    Status ok = device_status(cudaGetDevice(&device), "the current device could not be read");
    if (ok) {
      ok = device_status(cudaDeviceGetAttribute(&is_supported, cudaDevAttrMemoryPoolsSupported, device),
                         "the device's properties could not be read");
    }
    if (!ok) return tl::unexpected(ok.error());
    if (is_supported == 0) return nullptr;
    const std::lock_guard lock(mutex);
    if (auto pool = pools[device].lock()) return pool;
    const auto pool = std::make_shared<DevicePool>();
    if (ok = pool->create(device); !ok) return tl::unexpected(ok.error());
    pools[device] = pool;
    return pool;
  }

  cudaError_t allocate(void** memory, std::uint64_t bytes) const {
    cudaError_t error = cudaMallocFromPoolAsync(memory, bytes, pool_, idle_.get());
    if (error != cudaErrorMemoryAllocation) return error == cudaSuccess ? cudaStreamSynchronize(idle_.get()) : error;
    cudaGetLastError();  // later calls must not report it
    // A pool grows in pieces of 32 MiB; cudaMalloc() has smaller ones, and stalls other streams only when memory is
    // short.
    cudaMemPoolTrimTo(pool_, 0);
    cudaStreamSynchronize(idle_.get());
    error = cudaMalloc(memory, bytes);
    if (error != cudaSuccess) return error;
    try {
      const std::lock_guard lock(mutex_);
      outside_.insert(*memory);
    } catch (const std::bad_alloc&) {  // growing workspaces clean up after errors, not exceptions
      cudaFree(*memory);
      return cudaErrorMemoryAllocation;
    }
    return cudaSuccess;
  }
  void free(void* memory) const {
    bool is_outside = false;
    {
      const std::lock_guard lock(mutex_);
      is_outside = outside_.erase(memory) != 0;
    }
    if (is_outside) {
      cudaFree(memory);
      return;
    }
    cudaFreeAsync(memory, idle_.get());
    cudaStreamSynchronize(idle_.get());
  }

 private:
  Status create(int device) {
    cudaMemPoolProps properties{};
    properties.allocType = cudaMemAllocationTypePinned;
    properties.location.type = cudaMemLocationTypeDevice;
    properties.location.id = device;
    const Status ok = idle_.create();
    return ok ? device_status(cudaMemPoolCreate(&pool_, &properties), "a memory pool could not be made") : ok;
  }

  // Allocations and frees ordered by a stream on which nothing else is queued, and which is waited for, hold for all
  // streams, and no other stream has to stop.
  OwnedStream idle_;
  cudaMemPool_t pool_ = nullptr;
  mutable std::mutex mutex_;
  mutable std::set<void*> outside_;  // not from the pool, which had no room
};

Result<std::shared_ptr<const DeviceMemory>> DeviceMemory::create(const DeviceAllocator& allocator) {
  auto memory = std::make_shared<DeviceMemory>();
  memory->allocator_ = allocator;
  if ((allocator.allocate == nullptr) != (allocator.free == nullptr)) {
    return make_error(Errc::bad_argument, Error::kNone, "an allocator has only one of its two functions");
  }
  if (allocator.allocate == nullptr) {
    auto pool = DevicePool::shared();
    if (!pool) return tl::unexpected(pool.error());
    memory->pool_ = *std::move(pool);
  }
  return memory;
}

Result<void*> DeviceMemory::allocate(std::uint64_t bytes, CudaStream stream) const {
  void* memory = nullptr;
  cudaError_t error = cudaSuccess;
  if (allocator_.allocate != nullptr) {
    memory = allocator_.allocate(allocator_.user, bytes, stream);
    if (memory == nullptr) {
      cudaGetLastError();  // a failed cudaMalloc() of the caller's; later calls must not report it
      error = cudaErrorMemoryAllocation;
    }
  } else {
    error = pool_ ? pool_->allocate(&memory, bytes) : cudaMalloc(&memory, bytes);
    if (error != cudaSuccess) cudaGetLastError();  // later calls must not report it
  }
  if (error == cudaSuccess) return memory;
  if (error != cudaErrorMemoryAllocation) {
    return tl::unexpected(device_status(error, "device memory cannot be allocated").error());
  }
  return make_error(Errc::device_out_of_memory, Error::kNone, "the device does not have this much free memory", bytes);
}

void DeviceMemory::free(void* memory, std::uint64_t bytes) const {
  if (allocator_.free != nullptr) {
    allocator_.free(allocator_.user, memory, bytes);
  } else if (pool_) {
    pool_->free(memory);
  } else {
    cudaFree(memory);
  }
}

std::size_t room_for(std::uint64_t bytes) {
  std::size_t free = 0, all = 0;
  if (cudaMemGetInfo(&free, &all) != cudaSuccess) {
    cudaGetLastError();
    return 0;
  }
  return free / 2 / std::max<std::uint64_t>(bytes, 1);
}

}  // namespace rgs::detail
