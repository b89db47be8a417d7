// value_checks.hpp - what load_direct(), read_chunks() and pages share with validate().
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>

#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::detail {

/// What the declarations state about all Gaussians, summed up in any order.
struct ValueTotals {
  ValueCounts counts;
  Box full;
  bool empty = true;

  void add(const ValueTotals& other) {
    counts.add(other.counts);
    for (std::size_t k = 0; k < 3 && !other.empty; ++k) {
      full.min[k] = empty ? other.full.min[k] : std::min(full.min[k], other.full.min[k]);
      full.max[k] = empty ? other.full.max[k] : std::max(full.max[k], other.full.max[k]);
    }
    empty = empty && other.empty;
  }
};

/// Rows of one chunk, and where byte `byte` of its row `row` (of the chunk's entry: row 0) is in the file.
struct ChunkRows {
  const std::byte *means, *geometry, *sh;
  int sh_degree, scale_exponent;
  std::function<std::uint64_t(SectionType type, std::uint64_t row, std::uint64_t byte)> place;
};
/// Rows and entry of a chunk against the specification and each other. Errors: bad_value, reserved_bits.
Status check_chunk_rows(const ChunkRows& rows, const ChunkEntry& entry, const ShStepSet& steps, ValueTotals& totals);

/// SH steps that a file of that degree may have, which begin at byte `offset` of the file, or whose every byte counts as being
/// there. Errors: bad_value.
Status check_step_set(const ShStepSet& set, int sh_degree, std::uint64_t offset, bool coded);

/// check_page_values(), adding to `totals`.
Status check_page_rows(const PagedFile& file, std::uint32_t page, const PageRows& rows, ValueTotals& totals);

/// The declarations against what the Gaussians hold. Errors: bad_value.
Status check_declarations(const FileView& view, const ValueTotals& totals);
/// Positions in the source, all different. Errors: bad_value.
Status check_permutation(const FileView& view);

/// Values of the range against the specification and their chunks' entries.
Status check_values(const DirectData& data, unsigned threads);
/// `data` is the whole file: all that validate() checks but the hashes of coded sections, whose frames were checked.
Status check_file(const DirectData& data, unsigned threads);

}  // namespace rgs::detail
