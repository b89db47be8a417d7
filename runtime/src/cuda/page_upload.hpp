// page_upload.hpp - a file with levels of detail to the device: all of its pages, and their table.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "common/cut.hpp"
#include "cuda/file_upload.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::detail {

/// Where pages that are there lie on the device: each begins with a chunk of its own, its last chunk is filled up with rows that
/// are never drawn.
struct PagePlan {
  explicit PagePlan(const PagedFile& file);

  std::uint32_t n_pages = 0;
  std::uint32_t chunk_size = 0;
  std::vector<std::uint64_t> first_chunk, first_set;  ///< [n_pages + 1] chunks and SH step sets of the pages before
  std::uint64_t n_finest = 0;                         ///< Gaussians of the pages that are drawn at detail 0

  std::uint64_t n_chunks() const { return first_chunk.back(); }
  std::uint64_t n_rows() const { return n_chunks() * chunk_size; }
  /// MEAN, GEOM, SHI8, SHSC, CHNK.
  std::array<std::uint64_t, 5> section_bytes(int sh_degree) const;
  /// The pages as the choice of them reads them.
  std::vector<cuda::CutPage> table(const PagedFile& file) const;

 private:
  bool has_children(const PagedFile& file, std::uint32_t page) const;
};

/// Decodes and checks all pages that are there, on all threads, a few at a time, and copies them to `places`; waits for that.
/// Errors: those of PageDecoder and check_page_values(), device_failed.
Status upload_pages(const PagedFile& file, const PagePlan& plan, const SectionPlaces& places, CudaStream stream);

}  // namespace rgs::detail
