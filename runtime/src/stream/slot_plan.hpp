// slot_plan.hpp - how a device's memory is divided into slots of one size, each for any page of a scene. Arithmetic
// alone.
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
  std::uint32_t page_chunks = 0;  ///< of a page, at most
  int sh_degree = 0;

  static SlotShape of(const PagedFile& file);
  bool operator==(const SlotShape&) const = default;
  std::uint64_t rows() const { return std::uint64_t{chunk_size} * page_chunks; }
  /// MEAN, GEOM, SHI8, SHSC, CHNK of one slot.
  std::array<std::uint64_t, 5> section_bytes() const;
  std::uint64_t bytes() const;  ///< of one slot
};

/// One allocation: all slots of a section, then those of the next.
struct SlotPlan {
  SlotShape shape;
  std::uint32_t n_slots = 0;
  std::array<std::uint64_t, 5> begin{};  ///< of each section, multiples of 256
  std::uint64_t bytes = 0;               ///< of all; at most the budget

  /// Offset of section k of a slot.
  std::uint64_t at(std::size_t k, std::uint32_t slot) const { return begin[k] + slot * shape.section_bytes()[k]; }
  std::uint64_t slot_bytes() const { return shape.bytes(); }
  std::uint32_t first_chunk(std::uint32_t slot) const { return slot * shape.page_chunks; }
};

/// As many slots as the budget holds and kernels can index. Errors: limit_exceeded (none fits; Error::expected: bytes
/// of one).
Result<SlotPlan> plan_slots(const SlotShape& shape, std::uint64_t budget);

/// Page-locked memory of a thread that fills slots, in pages of the largest size: some are copied while the next are
/// decoded. kStagedPages are two groups of the usual size; where the host's budget is small a thread has fewer, but at
/// least kLeastStagedPages.
inline constexpr std::uint32_t kStagedPages = 8, kLeastStagedPages = 2;
/// Staging bytes of a section and of a page; each section starts at a multiple of 256.
std::uint64_t staged_section_bytes(std::uint64_t bytes);
std::uint64_t staged_bytes(const std::array<std::uint64_t, 5>& section_bytes);
std::uint64_t staging_bytes(const SlotShape& shape, std::uint32_t n_pages);

/// Offsets in a ring of memory, released in the order in which they were taken.
class StagingRing {
 public:
  explicit StagingRing(std::uint64_t bytes) : bytes_(bytes) {}
  /// Offset of `n` contiguous bytes, at most the whole ring; absent until older ones are released.
  std::optional<std::uint64_t> take(std::uint64_t n);
  /// Sum of all that was ever taken; bytes skipped at the ring's end count to the next piece.
  std::uint64_t taken() const { return taken_; }
  /// Releases everything up to that value of taken().
  void release_up_to(std::uint64_t taken) { released_ = taken; }

 private:
  std::uint64_t bytes_, next_ = 0, taken_ = 0, released_ = 0;
};

}  // namespace rgs::detail
