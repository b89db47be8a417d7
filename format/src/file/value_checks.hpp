// value_checks.hpp - checks that load_direct(), read_chunks() and pages share with validate().
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

/// What the declarations state of all Gaussians, summed in any order.
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

/// Rows of a chunk; `place` maps byte `byte` of row `row` (row 0 for the chunk's entry) to its offset in the file.
struct ChunkRows {
  const std::byte *means, *geometry, *sh;
  int sh_degree, scale_exponent;
  std::function<std::uint64_t(SectionType type, std::uint64_t row, std::uint64_t byte)> place;
};
/// Checks rows and entry of a chunk against the specification and each other. Errors: bad_value, reserved_bits.
Status check_chunk_rows(const ChunkRows& rows, const ChunkEntry& entry, const ShStepSet& steps, ValueTotals& totals);

/// Checks the SH steps at byte `offset` of the file against the degree; if `coded`, errors report `offset` for every
/// byte. Errors: bad_value.
Status check_step_set(const ShStepSet& set, int sh_degree, std::uint64_t offset, bool coded);

/// check_page_values(), adding to `totals`.
Status check_page_rows(const PagedFile& file, std::uint32_t page, const PageRows& rows, ValueTotals& totals);

/// Checks the declarations against the Gaussians. Errors: bad_value.
Status check_declarations(const FileView& view, const ValueTotals& totals);
/// Checks that positions in the source differ. Errors: bad_value.
Status check_permutation(const FileView& view);

/// Checks values of the range against the specification and their chunks' entries.
Status check_values(const DirectData& data, unsigned threads);
/// Makes all checks of validate() on the whole file, except the hashes of coded sections, whose frames were checked.
Status check_file(const DirectData& data, unsigned threads);

}  // namespace rgs::detail
