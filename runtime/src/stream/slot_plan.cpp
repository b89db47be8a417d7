// slot_plan.cpp - the arithmetic of slots.
// SPDX-License-Identifier: Apache-2.0
#include "stream/slot_plan.hpp"

#include <algorithm>
#include <limits>

#include "page_sections.hpp"

namespace rgs::detail {
namespace {

constexpr std::uint64_t kAlignment = 256;
// Kernels index rows with 31 bits.
constexpr std::uint64_t kMostRows = std::numeric_limits<std::int32_t>::max();

std::uint64_t aligned(std::uint64_t bytes) {
  return (bytes + kAlignment - 1) / kAlignment * kAlignment;
}

SlotPlan plan_of(const SlotShape& shape, std::uint32_t n_slots) {
  SlotPlan plan{shape, n_slots};
  const auto sizes = shape.section_bytes();
  for (std::size_t k = 0; k < sizes.size(); ++k) {
    plan.begin[k] = plan.bytes;
    plan.bytes += aligned(n_slots * sizes[k]);
  }
  return plan;
}

}  // namespace

SlotShape SlotShape::of(const PagedFile& file) {
  const Header& header = file.head().header();
  return {header.chunk_size, file.page_chunks(), header.sh_degree};
}

std::array<std::uint64_t, 5> SlotShape::section_bytes() const {
  const std::array<std::uint64_t, 5> row = section_row_bytes(sh_degree);
  return {rows() * row[0], rows() * row[1], rows() * row[2], page_chunks * row[3], page_chunks * row[4]};
}

std::uint64_t SlotShape::bytes() const {
  std::uint64_t sum = 0;
  for (const std::uint64_t bytes : section_bytes()) sum += bytes;
  return sum;
}

Result<SlotPlan> plan_slots(const SlotShape& shape, std::uint64_t budget) {
  // Aligning the sections may cost a slot.
  std::uint64_t n = std::min(budget / shape.bytes(), kMostRows / shape.rows());
  while (n > 0 && plan_of(shape, static_cast<std::uint32_t>(n)).bytes > budget) --n;
  if (n == 0) {
    return make_error(Errc::limit_exceeded, Error::kNone, "the device's budget holds no page of the scene",
                      plan_of(shape, 1).bytes, budget);
  }
  return plan_of(shape, static_cast<std::uint32_t>(n));
}

std::uint64_t staged_section_bytes(std::uint64_t bytes) {
  return aligned(bytes);
}

std::uint64_t staged_bytes(const std::array<std::uint64_t, 5>& section_bytes) {
  std::uint64_t sum = 0;
  for (const std::uint64_t bytes : section_bytes) sum += aligned(bytes);
  return sum;
}

std::uint64_t staging_bytes(const SlotShape& shape, std::uint32_t n_pages) {
  return n_pages * staged_bytes(shape.section_bytes());
}

std::optional<std::uint64_t> StagingRing::take(std::uint64_t n) {
  if (taken_ == released_) next_ = 0;
  const bool is_over = n > bytes_ - next_;
  const std::uint64_t lost = is_over ? bytes_ - next_ : 0, used = taken_ - released_;
  if (n + lost > bytes_ - used) return std::nullopt;
  const std::uint64_t at = is_over ? 0 : next_;
  next_ = at + n;
  taken_ += n + lost;
  return at;
}

}  // namespace rgs::detail
