// page_sections.hpp - a decoded page in the devices' layout: whole chunks, the last one padded.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::detail {

/// Bytes of a row of MEAN, GEOM, SHI8, of a step set (SHSC) and of an entry (CHNK).
constexpr std::array<std::uint64_t, 5> section_row_bytes(int sh_degree) {
  return {kMeanBytes, kGeometryBytes, sh_bytes(sh_degree), kStepSetBytes, kChunkEntryBytes};
}

/// Rows of each section for a page of n Gaussians.
constexpr std::array<std::uint64_t, 5> section_rows(std::uint32_t n, std::uint64_t n_step_sets,
                                                    std::uint32_t chunk_size) {
  const std::uint64_t n_chunks = (std::uint64_t{n} + chunk_size - 1) / chunk_size, n_rows = n_chunks * chunk_size;
  return {n_rows, n_rows, n_rows, n_step_sets, n_chunks};
}

/// Writes section_rows() of a page of checked values to `to`, in the layout of cuda::PagedAttributes: padding rows are
/// in no view, and entries count step sets from `first_set` on.
void write_page_sections(const PageRows& page, std::uint32_t chunk_size, std::uint64_t first_set,
                         const std::array<std::byte*, 5>& to);

}  // namespace rgs::detail
