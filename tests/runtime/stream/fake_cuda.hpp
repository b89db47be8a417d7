// fake_cuda.hpp - a CUDA runtime without a device: copies run as late as stream order allows, or at any time, on a
// thread.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>

namespace rgs::test {

/// Two devices during its lifetime; without one there is none. One at a time. Each thread's current device starts as
/// the first.
class FakeCuda {
 public:
  enum class Pace : std::uint8_t {
    late,      ///< queued work runs when somebody waits for it, and not before
    any_time,  ///< a thread runs it, switching between streams
    at_once,   ///< queued work runs at once
  };
  explicit FakeCuda(Pace pace, std::uint64_t device_memory = std::uint64_t{1} << 30, unsigned seed = 1);
  FakeCuda(const FakeCuda&) = delete;
  FakeCuda& operator=(const FakeCuda&) = delete;
  ~FakeCuda();

  static FakeCuda* current();

  /// Whether a copy to these bytes of the device is in flight.
  bool is_written(const std::byte* from, std::size_t bytes) const;
  /// Copies in flight.
  std::size_t n_pending() const;
  /// Whether these bytes are allocated on either device.
  bool is_allocated(const std::byte* from, std::size_t bytes) const;

  std::atomic<std::uint64_t> device_bytes{0}, most_device_bytes{0}, pinned_bytes{0}, most_pinned_bytes{0};
  std::atomic<int> n_allocations{0};  ///< of device memory, in all
  /// Faults of the caller: unallocated bytes, memory freed while in use, a stream or an event of another device, a
  /// launch while another device is current.
  std::atomic<int> n_faults{0};
  std::atomic<int> passes_next{0};                     ///< copies that succeed first
  std::atomic<int> fails_next{0};                      ///< copies that then fail
  std::atomic<int> query_fails_next{0};                ///< event queries that fail
  std::atomic<int> sync_passes_next{0};                ///< waits for a stream that succeed first
  std::atomic<int> sync_fails_next{0};                 ///< waits that then fail after the stream's work
  std::atomic<int> n_sent_at_failure{0};               ///< sends in flight at the last failure of a copy or a wait
  std::atomic<int> device_without_code{-1};            ///< by number
  std::atomic<int> n_batches{0};                       ///< launches that copy pages
  std::atomic<int> n_seen_done{0}, n_seen_at_work{0};  ///< results of event queries
  std::atomic<int> n_set_device{0};                    ///< calls of cudaSetDevice()
  std::atomic<std::uint64_t> workspace_bytes{0};       ///< a Gaussian that the backend draws
  std::atomic<int> n_unfit{0};                         ///< frames that did not fit the workspace
  std::atomic<int> n_on_second{0};                     ///< allocations on the second device, in all

  struct Impl;
  std::unique_ptr<Impl> impl;
};

}  // namespace rgs::test
