// device_slots.hpp - slots for pages in a device's memory, and the writer that fills them. Built with and without CUDA.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"
#include "stream/slot_plan.hpp"

namespace rgs::detail {

/// What the renderers of a pool share to draw, one frame at a time.
class FrameWorkspace {
 public:
  explicit FrameWorkspace(std::uint64_t bytes) : bytes_(bytes) {}
  std::uint64_t bytes() const { return bytes_; }  ///< most device memory
  std::uint64_t held() const { return held_; }
  bool fits(std::uint64_t n) const { return n <= bytes_ - held_; }

  // While drawing is locked.
  std::mutex drawing;
  void take(std::uint64_t n) { held_ += n; }  ///< fits(n)
  void release(std::uint64_t n) { held_ -= n; }

 private:
  const std::uint64_t bytes_;
  std::atomic<std::uint64_t> held_{0};

 public:
  std::shared_ptr<void> content;  ///< the CUDA backend's; releases what it holds
};

/// Slots on the device that was current at create(), allocated once. The pool's lock guards the list of free slots; a
/// taken slot's content belongs to its taker. All functions here and of SlotWriter, but stay_on_device(), leave the
/// caller's current device as it is.
class DeviceSlots {
 public:
  /// `workspace_memory`: see workspace(); allocated by frames. Errors: those of plan_slots(); unavailable (not built, no device answers, or no code for it), device_out_of_memory, device_failed.
  static Result<std::shared_ptr<DeviceSlots>> create(const SlotShape& shape, std::uint64_t device_memory,
                                                     std::uint64_t workspace_memory = 0);
  DeviceSlots(const DeviceSlots&) = delete;
  DeviceSlots& operator=(const DeviceSlots&) = delete;
  ~DeviceSlots();

  const SlotPlan& plan() const { return plan_; }
  /// A free slot; there must be one.
  std::uint32_t take() {
    const std::uint32_t slot = free_.back();
    free_.pop_back();
    return slot;
  }
  /// The slot is neither written nor drawn any more.
  void release(std::uint32_t slot) { free_.push_back(slot); }
  /// Host memory of the list of free slots.
  static std::uint64_t host_bytes(const SlotPlan& plan) { return plan.n_slots * sizeof(std::uint32_t); }

  FrameWorkspace& workspace() const { return *workspace_; }
  int device() const { return device_; }
  /// Makes this device the calling thread's, for good. For threads that only upload pages.
  void stay_on_device() const;
  /// Device address.
  std::byte* at(std::size_t section, std::uint32_t slot) const { return memory_ + plan_.at(section, slot); }

 private:
  DeviceSlots() = default;
  SlotPlan plan_;
  int device_ = 0;
  std::byte* memory_ = nullptr;
  std::vector<std::uint32_t> free_;
  std::unique_ptr<FrameWorkspace> workspace_;
};

/// What one thread needs to write pages to slots: page-locked memory and a stream of its own.
class SlotWriter {
 public:
  /// Numbers one send(). Later tickets are larger and complete later.
  using Ticket = std::uint64_t;

  /// `n_staged`: pages staged at once, which take staging_bytes() of the host. Errors: device_failed, unavailable
  /// (kernels do not reach the host's memory).
  static Result<SlotWriter> create(std::shared_ptr<const DeviceSlots> slots, std::uint32_t n_staged);
  SlotWriter(SlotWriter&&) noexcept;
  SlotWriter& operator=(SlotWriter&&) = delete;
  ~SlotWriter();  ///< waits

  /// Stages a page of checked values; `page` is not read after the return. If the ring is full, or 16
  /// sends are in flight, sends what is staged and waits for the oldest send. Errors: device_failed.
  Status write(const PageRows& page, std::uint32_t slot);
  /// Sends what is staged, with one launch. Errors: device_failed.
  Result<Ticket> send();
  /// Whether that send has reached its slots; does not wait. Errors: device_failed.
  Result<bool> is_done(Ticket ticket);
  /// Sends what is staged and waits for all of it. After any return nothing writes to a slot. Errors: device_failed.
  Status finish();

 private:
  struct Impl;
  explicit SlotWriter(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::detail
