// slot_plan.hpp - how pages share a device's memory: slots of one size, each with room for any page of a scene. Arithmetic alone.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

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

/// Page-locked memory of a thread that brings pages to slots: while one is copied, the next is made.
inline constexpr std::uint32_t kStagedPages = 2;
std::uint64_t staged_section_bytes(const SlotShape& shape, std::size_t section);  ///< of one page
std::uint64_t staging_bytes(const SlotShape& shape);

}  // namespace rgs::detail
