// page_table.hpp - section LODS: serialises and parses the tree of pages; and the layout of a decoded page in memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "file/checked.hpp"
#include "file/row_kernels.hpp"
#include "rgs/layout.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// What a page's record is checked against.
struct PageContext {
  const Header& header;
  const SectionEntry& levels;               ///< entry of LODS
  const SectionEntry& pages;                ///< entry of PAGE
  std::uint64_t levels_entry, pages_entry;  ///< their offsets
};

std::vector<std::byte> write_page_table(const PageTable& table);

// The section is read in parts: its head, its records as they arrive, then checks of the whole table. All these may
// fail with size_mismatch, reserved_bits, bad_value, section_overlap, section_gap or limit_exceeded.

/// A table without pages. `bytes`: the section, or at least its first kLevelsHeadBytes if it is that long.
Result<PageTable> parse_levels_head(std::span<const std::byte> bytes, const PageContext& context,
                                    const DecodeLimits& limits);
/// Takes pages `from` on, of which the first is unknown, from complete records, up to a known page or one whose parent
/// is unknown, and checks them against known ones. When no page is left unknown, checks the whole table, and its hash
/// unless all records came at once: the caller has checked it then. After an error the table is unchanged.
Status extend_page_table(std::span<const std::byte> records, const PageContext& context, PageTable& table,
                         std::size_t from);
Status check_hash(const SectionEntry& entry, std::uint64_t hash);
/// Checks that pages decode to no more than a file of `file_bytes` may.
Status check_decoded_bytes(const PageContext& context, const DecodeLimits& limits, std::uint64_t file_bytes);

constexpr std::uint64_t chunks_of(std::uint64_t rows, std::uint32_t chunk_size) {
  return (rows + chunk_size - 1) / chunk_size;
}

/// Arrays of a decoded page, each at a multiple of 16.
struct PageLayout {
  std::uint64_t chunks = 0, steps = 0, means = 0, geometry = 0, sh = 0;  ///< offsets
  std::uint64_t bytes = 0;
};
constexpr PageLayout page_layout(std::uint64_t n, std::uint32_t chunk_size, std::uint64_t n_step_sets, int sh_degree) {
  const auto next = [](std::uint64_t end) { return align_up(end, kPageArrayAlignment); };
  PageLayout l;
  l.steps = chunks_of(n, chunk_size) * kChunkEntryBytes;
  l.means = l.steps + n_step_sets * kStepSetBytes;
  l.geometry = next(l.means + n * kMeanBytes);
  l.sh = l.geometry + n * kGeometryBytes;
  l.bytes = next(l.sh + n * sh_bytes(sh_degree));
  return l;
}
static_assert(kChunkEntryBytes % kPageArrayAlignment == 0 && kStepSetBytes % kPageArrayAlignment == 0);

/// `out` has the layout's size.
PageRows page_rows(std::span<const std::byte> out, const PageLayout& layout, std::uint32_t n, int scale_exponent,
                   int sh_degree);

/// Derives the chunk entries of a coded page, which stores none, from its rows of MEAN and GEOM.
void derive_chunks(std::span<std::byte> decoded, const PageLayout& layout, std::uint32_t n, std::uint32_t chunk_size,
                   std::uint64_t n_step_sets, int scale_exponent);

/// Bounds of a Gaussian's mean and of its 3-standard-deviation extent on each axis, in binary64, from stored rows.
struct Extent {
  double mean[3], reach[3];
};
Extent extent_of(const std::byte* mean, const std::byte* geometry, int scale_exponent);
/// Share of an extent that its page's box must hold; the rest allows for rounding.
inline constexpr double kExtentShare = 1 - 0x1p-10;

/// Whether a page's box holds Gaussians of legal values, without the roots of extent_of(). If true, kExtentShare of the
/// extent is in the box, however extent_of() is rounded; may be false for a Gaussian that the box holds.
class RoomInBox {
 public:
  RoomInBox(const Box& box, int scale_exponent);
  /// For a row of MEAN and of GEOM.
  bool is_enough(const std::byte* mean, const std::byte* geometry) const;
  /// For 1 to 64 rows, by binary32 vectors: bit i is set if these cannot confirm row i; is_enough() still may.
  std::uint64_t undecided(const std::byte* means, const std::byte* geometry, std::size_t count) const;

 private:
  const Box& box_;
  double scale_unit_;
  BoxInFp32 in_fp32_;
};

}  // namespace rgs::detail
