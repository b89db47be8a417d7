// page_store.hpp - a streamed scene's decoded pages: FP32 arrays on the host, for the CPU renderer, or slots of a
// device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"
#include "stream/device_slots.hpp"

namespace rgs::detail {

class PageStore {
 public:
  /// For all pages of `file`, which must outlive it. `slots`: null on the host.
  PageStore(const PagedFile& file, std::shared_ptr<DeviceSlots> slots);
  PageStore(const PageStore&) = delete;
  PageStore& operator=(const PageStore&) = delete;
  ~PageStore();

  bool is_on_device() const { return slots_ != nullptr; }
  const std::shared_ptr<DeviceSlots>& slots() const { return slots_; }
  /// Host memory of a store, without pages.
  static std::uint64_t bytes(std::uint32_t n_pages, const DeviceSlots* slots);
  /// Of the host's budget, or of slots: page + row bytes a Gaussian.
  struct Cost {
    std::uint64_t page, row;
  };
  Cost cost() const;

  // With the pool's lock, once the room is taken.
  void reserve(std::uint32_t page);  ///< before put()
  void free(std::uint32_t page);     ///< a reserved page, stored or not

  /// Stores a reserved page, on the thread that reads it, and checks its values first. `writer`: of that thread, on a
  /// device; its send() copies the page to the slot. Errors: those of check_page_values() and SlotWriter::write().
  Status put(std::uint32_t page, const PageRows& rows, SlotWriter* writer);

  /// What a frame draws of a resident page.
  ScenePart part(std::uint32_t page) const;                                       ///< on the host
  void add_chunks(std::uint32_t page, std::vector<std::uint32_t>& chunks) const;  ///< on a device, of all slots' chunks

 private:
  static constexpr std::uint32_t kNoSlot = ~0u;

  const PagedFile& file_;
  std::shared_ptr<DeviceSlots> slots_;
  std::vector<std::unique_ptr<float[]>> blocks_;  // [pages] on the host
  std::vector<std::uint32_t> slot_of_;            // [pages] on a device
};

}  // namespace rgs::detail
