// fake_cuda.hpp - a CUDA runtime without a device: copies happen as late as their streams' order allows, or at any time, on a thread.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>

namespace rgs::test {

/// Two devices, while it is there; without one there is none. One at a time. Each thread has a current device, the first as it begins.
class FakeCuda {
 public:
  enum class Pace : std::uint8_t {
    late,      ///< what is queued is done when somebody waits for it, and not before
    any_time,  ///< a thread does it, now of one stream, now of another
    at_once,   ///< it is done as it is queued
  };
  explicit FakeCuda(Pace pace, std::uint64_t device_memory = std::uint64_t{1} << 30, unsigned seed = 1);
  FakeCuda(const FakeCuda&) = delete;
  FakeCuda& operator=(const FakeCuda&) = delete;
  ~FakeCuda();

  static FakeCuda* current();

  /// Whether a copy to these bytes of the device is on its way.
  bool is_written(const std::byte* from, std::size_t bytes) const;
  /// Copies that are on their way.
  std::size_t n_pending() const;
  /// Whether they are the first device's or the second's, allocated.
  bool is_allocated(const std::byte* from, std::size_t bytes) const;

  std::atomic<std::uint64_t> device_bytes{0}, most_device_bytes{0}, pinned_bytes{0}, most_pinned_bytes{0};
  std::atomic<int> n_allocations{0};  ///< of the device's memory, ever
  /// Of the caller: bytes that are nobody's, memory freed while it is in use, a stream or an event of another device, a launch while another
  /// device is current.
  std::atomic<int> n_faults{0};
  std::atomic<int> passes_next{0};           ///< so many copies are not refused first
  std::atomic<int> fails_next{0};            ///< then so many are
  std::atomic<int> query_fails_next{0};      ///< so many questions after events
  std::atomic<int> sync_passes_next{0};      ///< so many waits for a stream end well first
  std::atomic<int> sync_fails_next{0};       ///< then so many end with an error, the stream's work done
  std::atomic<int> n_sent_at_failure{0};     ///< sends that were on their way when a copy or a wait failed last
  std::atomic<int> device_without_code{-1};  ///< by its number
  std::atomic<int> n_batches{0};             ///< launches that bring pages
  std::atomic<int> n_seen_done{0}, n_seen_at_work{0};  ///< answers about events
  std::atomic<int> n_set_device{0};                    ///< calls of cudaSetDevice()
  std::atomic<int> n_on_second{0};                     ///< allocations of the second device's memory, ever

  struct Impl;
  std::unique_ptr<Impl> impl;
};

}  // namespace rgs::test
