// page_store.cpp - stores and frees pages, on the host or on a device.
// SPDX-License-Identifier: Apache-2.0
#include "stream/page_store.hpp"

#include <cassert>
#include <utility>

#include "splat_arrays.hpp"
#include "stream/stream_times.hpp"

namespace rgs::detail {
namespace {

/// An allocator adds some bytes to each block; a large block is whole pages of the system.
constexpr std::uint64_t kAllocationBytes = 32, kLargeBlock = 64 << 10, kSystemPage = 4096;

}  // namespace

PageStore::PageStore(const PagedFile& file, std::shared_ptr<DeviceSlots> slots)
    : file_(file), slots_(std::move(slots)) {
  if (slots_ == nullptr) {
    blocks_.resize(file.n_pages_in_all());
  } else {
    slot_of_.resize(file.n_pages_in_all(), kNoSlot);
  }
}

PageStore::~PageStore() {
  for (const std::uint32_t slot : slot_of_) {
    if (slot != kNoSlot) slots_->release(slot);
  }
}

// Every scene counts the list of free slots that they share.
std::uint64_t PageStore::bytes(std::uint32_t n_pages, const DeviceSlots* slots) {
  if (slots == nullptr) return n_pages * sizeof(std::unique_ptr<float[]>);
  return n_pages * sizeof(std::uint32_t) + DeviceSlots::host_bytes(slots->plan());
}

PageStore::Cost PageStore::cost() const {
  if (slots_ != nullptr) return {slots_->plan().slot_bytes(), 0};
  const std::uint64_t row = SplatArrays::floats(file_.head().header().sh_degree) * sizeof(float);
  const std::uint64_t most = row * file_.page_chunks() * file_.head().header().chunk_size;
  return {kAllocationBytes + (most >= kLargeBlock ? kSystemPage : 0), row};
}

void PageStore::reserve(std::uint32_t page) {
  if (slots_ == nullptr) return;
  assert(slot_of_[page] == kNoSlot);
  slot_of_[page] = slots_->take();
}

void PageStore::free(std::uint32_t page) {
  if (slots_ == nullptr) {
    blocks_[page].reset();
  } else if (const std::uint32_t slot = std::exchange(slot_of_[page], kNoSlot); slot != kNoSlot) {
    slots_->release(slot);
  }
}

Status PageStore::put(std::uint32_t page, const PageRows& rows, SlotWriter* writer) {
  if (slots_ != nullptr) {
    {
      const StreamTimer timer(StreamStep::check);
      if (Status checked = check_page_values(file_, page, rows); !checked) return checked;
    }
    return writer->write(rows, slot_of_[page]);
  }
  const int sh_degree = file_.head().header().sh_degree;
  auto block = SplatArrays::memory(rows.n, sh_degree);
  if (Status set = SplatArrays(block.get(), rows.n, sh_degree).set_page(file_, page, rows, 0); !set) return set;
  blocks_[page] = std::move(block);
  return {};
}

ScenePart PageStore::part(std::uint32_t page) const {
  const std::uint64_t n = file_.pages()[page].count;
  const SplatArrays a(blocks_[page].get(), n, file_.head().header().sh_degree);
  return {n, a.mean, a.rotation, a.scale, a.opacity, a.sh};
}

void PageStore::add_chunks(std::uint32_t page, std::vector<std::uint32_t>& chunks) const {
  const SlotPlan& plan = slots_->plan();
  const std::uint32_t first = plan.first_chunk(slot_of_[page]);
  const std::uint32_t n = (file_.pages()[page].count - 1) / plan.shape.chunk_size + 1;
  for (std::uint32_t k = 0; k < n; ++k) chunks.push_back(first + k);
}

}  // namespace rgs::detail
