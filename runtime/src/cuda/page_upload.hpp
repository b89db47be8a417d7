// page_upload.hpp - uploads all pages of a file with levels of detail, and their table.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "common/cut.hpp"
#include "cuda/file_upload.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::detail {

/// Offsets of pages on the device: each starts with a new chunk, and its last chunk is padded with rows that are never
/// drawn.
struct PagePlan {
  explicit PagePlan(const PagedFile& file);

  std::uint32_t n_pages = 0;
  std::uint32_t chunk_size = 0;
  std::vector<std::uint64_t> first_chunk, first_set;  ///< [n_pages + 1] chunks and SH step sets before each page
  std::uint64_t n_finest = 0;                         ///< Gaussians drawn at detail 0

  std::uint64_t n_chunks() const { return first_chunk.back(); }
  std::uint64_t n_rows() const { return n_chunks() * chunk_size; }
  /// MEAN, GEOM, SHI8, SHSC, CHNK.
  std::array<std::uint64_t, 5> section_bytes(int sh_degree) const;
  /// The table from which the device chooses the cut: see cuda::CutArguments.
  std::vector<cuda::CutPage> table(const PagedFile& file) const;

 private:
  bool has_children(const PagedFile& file, std::uint32_t page) const;
};

/// Decodes and checks all pages that the file contains, on all threads, a few at a time, copies them to `places` and
/// waits. Errors: those of PageDecoder and check_page_values(), device_failed.
Status upload_pages(const PagedFile& file, const PagePlan& plan, const SectionPlaces& places, CudaStream stream);

}  // namespace rgs::detail
