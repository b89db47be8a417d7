// slot_plan.hpp - how pages share a device's memory: slots of one size, each with room for any page of a scene. Arithmetic alone.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// What scenes must have in common to share slots.
struct SlotShape {
  std::uint32_t chunk_size = 0;   ///< Gaussians
  std::uint32_t page_chunks = 0;  ///< most of a page
  int sh_degree = 0;

  static SlotShape of(const PagedFile& file);
  bool operator==(const SlotShape&) const = default;
  std::uint64_t rows() const { return std::uint64_t{chunk_size} * page_chunks; }
  /// MEAN, GEOM, SHI8, SHSC, CHNK of one slot.
  std::array<std::uint64_t, 5> section_bytes() const;
  std::uint64_t bytes() const;  ///< of one slot
};

/// One allocation: of each section all slots, one after the other.
struct SlotPlan {
  SlotShape shape;
  std::uint32_t n_slots = 0;
  std::array<std::uint64_t, 5> begin{};  ///< of each section, multiples of 256
  std::uint64_t bytes = 0;               ///< of all; at most the budget

  /// Where section k of a slot begins.
  std::uint64_t at(std::size_t k, std::uint32_t slot) const { return begin[k] + slot * shape.section_bytes()[k]; }
  std::uint64_t slot_bytes() const { return shape.bytes(); }
  std::uint32_t first_chunk(std::uint32_t slot) const { return slot * shape.page_chunks; }
};

/// As many slots as fit in a budget, and as kernels can number. Errors: limit_exceeded (not even one fits: Error::expected has the bytes that one
/// takes).
Result<SlotPlan> plan_slots(const SlotShape& shape, std::uint64_t budget);

/// Page-locked memory of a thread that brings pages to slots, in pages of the largest size: some are copied while the next are made. A thread has
/// kStagedPages of them, two groups of the usual size, or fewer where the host's budget is small, but never fewer than kLeastStagedPages.
inline constexpr std::uint32_t kStagedPages = 8, kLeastStagedPages = 2;
/// What a section, and a page of such sections, takes of it: each begins at a multiple of 256.
std::uint64_t staged_section_bytes(std::uint64_t bytes);
std::uint64_t staged_bytes(const std::array<std::uint64_t, 5>& section_bytes);
std::uint64_t staging_bytes(const SlotShape& shape, std::uint32_t n_pages);

/// Places in a ring of memory, given back in the order in which they were taken.
class StagingRing {
 public:
  explicit StagingRing(std::uint64_t bytes) : bytes_(bytes) {}
  /// Where `n` bytes in one piece begin, at most all of the ring; absent if others have to be given back first.
  std::optional<std::uint64_t> take(std::uint64_t n);
  /// All that was ever taken; what is lost at the ring's end counts to the place after it.
  std::uint64_t taken() const { return taken_; }
  /// Everything up to that value of taken() is free.
  void release_up_to(std::uint64_t taken) { released_ = taken; }

 private:
  std::uint64_t bytes_, next_ = 0, taken_ = 0, released_ = 0;
};

}  // namespace rgs::detail
