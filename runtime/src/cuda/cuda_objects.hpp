// cuda_objects.hpp - owned objects of the CUDA runtime, and its errors as values.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#include "rgs/result.hpp"

namespace rgs::detail {

/// device_failed with the runtime's error number in Error::found. Clears the runtime's error, so that later calls do
/// not report it.
inline Status device_status(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();
  return make_error(Errc::device_failed, Error::kNone, what, Error::kNone, static_cast<std::uint64_t>(error));
}

/// Makes a device current for its lifetime, then restores the one before. Sets nothing if it is current already:
/// cudaSetDevice() creates a context of hundreds of megabytes on a device without one.
class OnDevice {
 public:
  explicit OnDevice(int device) {
    status_ = device_status(cudaGetDevice(&before_), "the current device could not be read");
    if (!status_ || before_ == device) return;
    status_ = device_status(cudaSetDevice(device), kNotCurrent);
    is_changed_ = status_.has_value();
  }
  OnDevice(const OnDevice&) = delete;
  OnDevice& operator=(const OnDevice&) = delete;
  ~OnDevice() {
    if (is_changed_) cudaSetDevice(before_);
  }
  /// Errors: device_failed.
  const Status& status() const { return status_; }

  static constexpr const char* kNotCurrent = "a device could not be made current";

 private:
  int before_ = 0;
  bool is_changed_ = false;
  Status status_;
};

/// A point in a stream's work. All functions may fail with device_failed.
class Event {
 public:
  Event() = default;
  Event(const Event&) = delete;
  Event& operator=(const Event&) = delete;
  ~Event() {
    if (event_ != nullptr) cudaEventDestroy(event_);
  }
  Status create(unsigned flags = cudaEventDisableTiming) {
    return device_status(cudaEventCreateWithFlags(&event_, flags), "an event could not be made");
  }
  Status record(cudaStream_t stream) const {
    return device_status(cudaEventRecord(event_, stream), "an event could not be recorded");
  }
  /// Work queued on `stream` from now on waits for the event.
  Status hold(cudaStream_t stream, unsigned flags = 0) const {
    return device_status(cudaStreamWaitEvent(stream, event_, flags), "a stream could not be made to wait");
  }
  /// Blocks the host until the event; returns at once if it was never recorded.
  Status wait() const { return device_status(cudaEventSynchronize(event_), "a kernel failed"); }
  /// Whether the event has passed, without waiting; true if it was never recorded.
  Result<bool> is_done() const {
    const cudaError_t error = cudaEventQuery(event_);
    if (error == cudaErrorNotReady) {
      cudaGetLastError();
      return false;
    }
    if (const Status ok = device_status(error, "a kernel failed"); !ok) return tl::unexpected(ok.error());
    return true;
  }
  cudaEvent_t get() const { return event_; }

 private:
  cudaEvent_t event_ = nullptr;
};

/// A stream that does not synchronise with the default stream.
class OwnedStream {
 public:
  OwnedStream() = default;
  OwnedStream(const OwnedStream&) = delete;
  OwnedStream& operator=(const OwnedStream&) = delete;
  ~OwnedStream() {
    if (stream_ != nullptr) cudaStreamDestroy(stream_);
  }
  Status create(int priority = 0) {
    return device_status(cudaStreamCreateWithPriority(&stream_, cudaStreamNonBlocking, priority),
                         "a stream could not be made");
  }
  cudaStream_t get() const { return stream_; }

 private:
  cudaStream_t stream_ = nullptr;
};

/// Copies device memory to any host memory and waits for it. Avoids what blocks launches of other threads:
/// cudaMemcpy(), and for memory that is not page-locked also cudaMemcpyAsync() on the default stream. Errors:
/// device_failed.
inline Status copy_to_host(void* to, const void* from, std::uint64_t bytes, const OwnedStream& stream,
                           const char* what) {
  const Status copied = device_status(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToHost, stream.get()), what);
  const Status done = device_status(cudaStreamSynchronize(stream.get()), what);
  return copied ? done : copied;
}

/// Checks that kernels reach page-locked memory under the host's address. Errors: device_failed; unavailable (no
/// unified addressing).
inline Status reached_by_device(void* memory) {
  void* on_device = nullptr;
  const Status ok =
      device_status(cudaHostGetDevicePointer(&on_device, memory, 0), "the device does not reach host memory");
  if (!ok || on_device == memory) return ok;
  return make_error(Errc::unavailable, Error::kNone, "the CUDA device has no unified addressing; use the CPU backend");
}

/// A value in host memory that the device writes asynchronously.
template <class T>
class PageLocked {
 public:
  PageLocked() = default;
  PageLocked(const PageLocked&) = delete;
  PageLocked& operator=(const PageLocked&) = delete;
  ~PageLocked() { cudaFreeHost(value_); }
  /// Errors: device_failed; those of reached_by_device().
  Status create() {
    const Status ok = device_status(cudaHostAlloc(reinterpret_cast<void**>(&value_), sizeof(T), cudaHostAllocMapped),
                                    "page-locked host memory could not be allocated");
    return ok ? reached_by_device(value_) : ok;
  }
  /// Valid on the host and in kernels.
  T* get() const { return value_; }
  T* operator->() const { return value_; }

 private:
  T* value_ = nullptr;
};

}  // namespace rgs::detail
