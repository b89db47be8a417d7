// device_slots.hpp - a device's memory for pages, and how pages get there. In builds with and without CUDA.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"
#include "stream/slot_plan.hpp"

namespace rgs::detail {

/// Slots of the device that was current at create(), allocated once. Which are free is of the pool's lock; what is in a slot is of who has
/// taken it. But for stay_on_device(), these functions and those of writers leave the caller's current device as it is.
class DeviceSlots {
 public:
  /// Errors: those of plan_slots(); unavailable (not built, no device answers, or no code for it), device_out_of_memory, device_failed.
  static Result<std::shared_ptr<DeviceSlots>> create(const SlotShape& shape, std::uint64_t device_memory);
  DeviceSlots(const DeviceSlots&) = delete;
  DeviceSlots& operator=(const DeviceSlots&) = delete;
  ~DeviceSlots();

  const SlotPlan& plan() const { return plan_; }
  /// One that is free; there is one.
  std::uint32_t take() {
    const std::uint32_t slot = free_.back();
    free_.pop_back();
    return slot;
  }
  /// Nothing writes to it or draws it any more.
  void release(std::uint32_t slot) { free_.push_back(slot); }
  /// Memory that the list of free slots takes on the host.
  static std::uint64_t host_bytes(const SlotPlan& plan) { return plan.n_slots * sizeof(std::uint32_t); }

  int device() const { return device_; }
  /// Makes the device the calling thread's, for good: of threads that bring pages and do nothing else.
  void stay_on_device() const;
  /// On the device.
  std::byte* at(std::size_t section, std::uint32_t slot) const { return memory_ + plan_.at(section, slot); }

 private:
  DeviceSlots() = default;
  SlotPlan plan_;
  int device_ = 0;
  std::byte* memory_ = nullptr;
  std::vector<std::uint32_t> free_;
};

/// What one thread needs to bring pages to slots: page-locked memory, and a stream of its own.
class SlotWriter {
 public:
  /// Of what was sent together; later ones are larger, and there later.
  using Ticket = std::uint64_t;

  /// Takes staging_bytes() of the host for so many pages. Errors: device_failed, unavailable (kernels do not reach the host's memory).
  static Result<SlotWriter> create(std::shared_ptr<const DeviceSlots> slots, std::uint32_t n_staged);
  SlotWriter(SlotWriter&&) noexcept;
  SlotWriter& operator=(SlotWriter&&) = delete;
  ~SlotWriter();  ///< waits

  /// Takes a page of checked values, of which nothing is read after the return, to be sent. Where there is no room for it what was taken before
  /// is sent, and what was sent first waited for. Errors: device_failed.
  Status write(const PageRows& page, std::uint32_t slot);
  /// Sends what was taken: with one launch. Errors: device_failed.
  Result<Ticket> send();
  /// Whether what was sent with it is in its slots, without waiting. Errors: device_failed.
  Result<bool> is_done(Ticket ticket);
  /// Sends what was taken and waits until all is there. Whatever it returns, nothing writes to a slot any more. Errors: device_failed.
  Status finish();

 private:
  struct Impl;
  explicit SlotWriter(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::detail
