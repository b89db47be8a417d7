// parts_range.hpp - the contents of range.R: each stretch's pages as records of PageEncoder, and the rows from which
// pages above are built.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "failure.hpp"
#include "parts.hpp"
#include "rgs/page.hpp"
#include "work_file.hpp"

namespace rgs {

/// Pages of one level of a stretch; their records follow each other.
struct StretchLevel {
  std::vector<lod::Page> pages;  ///< first and first_child count within the stretch's level, and the level below
  std::vector<std::uint32_t> record_bytes;
  std::uint64_t offset = 0;  ///< of the first record
};

/// Bytes of the file, and their hash.
struct HashedBytes {
  std::uint64_t offset = 0, bytes = 0, xxh3 = 0;
};

struct BuiltStretch {
  std::vector<StretchLevel> levels;  ///< leaves first
  HashedBytes tops;                  ///< rows of the last level, if it has several pages
  HashedBytes positions;             ///< of the leaves in the source, if kept
};

using BuiltRange = std::vector<BuiltStretch>;

nlohmann::json about_range(const BuiltRange& range);
/// Errors: bad_value (a table is damaged).
Result<BuiltRange> range_of(const WorkFile& file);

}  // namespace rgs
