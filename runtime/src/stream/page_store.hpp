// page_store.hpp - where a streamed scene's decoded pages are: in the host's memory as FP32 arrays, for the CPU renderer, or in slots of a
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
  /// Memory of the host that a store takes beside pages.
  static std::uint64_t bytes(std::uint32_t n_pages, const DeviceSlots* slots);
  /// Room that a page takes: of the host's budget, or of slots.
  std::uint64_t page_bytes(std::uint32_t page) const;

  // With the pool's lock, which has the room for it.
  void reserve(std::uint32_t page);  ///< before put()
  void free(std::uint32_t page);     ///< reserved; put() or not

  /// Rows of a page that is reserved, by the thread that has it, once their values are checked. `writer`: of that thread, on a device, whose
  /// send() brings them there. Errors: those of check_page_values() and SlotWriter::write().
  Status put(std::uint32_t page, const PageRows& rows, SlotWriter* writer);

  /// What a frame draws of a page that is there.
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
