// levels_check.hpp - compares a share of a file's pages with their children: do their stated errors hold?
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "rgs/paged_file.hpp"

namespace rgs::tool {

struct RefutedPage {
  std::uint32_t page = 0;
  float measured = 0;  ///< error, world units a pixel
};

struct LevelsCheck {
  double share = 0;                          ///< of the pages with children that is checked, above 0, at most 1
  float tolerance = 0;                       ///< lod::kErrorTolerance or kLossyErrorTolerance
  std::uint32_t n_inner = 0, n_checked = 0;  ///< pages that are present with all their children; those checked
  std::vector<RefutedPage> refuted;          ///< by number
};

/// Where in the file the record of a page lies.
std::uint64_t record_offset(const PagedFile& file, std::uint32_t page);

/// Checks the share, rounded up, of the pages that are present with all their children. Which ones follows from the file's
/// table of pages alone. `file`: validated. Memory: one page and its children at a time, about 2 KiB a Gaussian; left out
/// where these are more than half a million.
/// Errors: those of read_pages().
Result<LevelsCheck> check_levels(const PagedFile& file, double share);

}  // namespace rgs::tool
