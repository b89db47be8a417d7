// levels_file.hpp - places the sections of a file with levels and writes its head, once pages are encoded.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "file/encode_plan.hpp"
#include "levels/page_table.hpp"
#include "rgs/checksum.hpp"
#include "rgs/scene_writer.hpp"

namespace rgs::detail {

struct EncodedPage {
  std::span<const std::byte> bytes;
  std::uint64_t xxh3 = 0;
  std::uint32_t n_step_sets = 0;
  std::int16_t scale_exponent = 0;
  std::array<std::uint32_t, 3> corner{};
  Box extent;  ///< holds the stored Gaussians out to 3 standard deviations
  std::uint16_t n_origins = 0;
};

/// Writes sections in the order DECL, CREF, LODS, ARCH, PROV, PAGE, PERM: sizes before PAGE are known in advance, and a
/// reader needs just these sections before the first page. All functions return the errors of their sink.
class LevelsFile {
 public:
  /// `archive`: content of ARCH, or empty. `table`: its pages and quality.
  LevelsFile(Sink sink, const EncodePlan& plan, PageTable table, std::span<const std::byte> archive);
  /// Adds the next page. Stored Gaussians above the leaves may reach farther, so the tree's boxes grow with them.
  Status add(const EncodedPage& page);
  std::size_t n_added() const { return n_added_; }
  const std::vector<lod::Page>& pages() const { return table_.pages; }
  /// Writes everything but the pages. `positions`: content of PERM, if the plan has it.
  Result<WrittenScene> finish(const Declarations& declarations, std::span<const std::uint32_t> positions);

 private:
  SectionEntry& entry(SectionType type);
  Status place(SectionType type, std::span<const std::byte> bytes);
  Sink sink_;
  Header header_;
  EncodeOptions options_;
  PageTable table_;
  std::vector<std::byte> archive_;
  std::vector<SectionEntry> sections_;  // offsets are known up to PAGE
  bool direct_;
  std::uint64_t end_ = 0;  // of the last page
  std::size_t n_added_ = 0;
  Hasher hash_;  // of PAGE
};

/// Smallest box of FP32 numbers around what is added.
class ExtentBox {
 public:
  void add(const Extent& extent);
  Box box() const;

 private:
  bool empty_ = true;
  std::array<double, 3> min_{}, max_{};
};

/// Most chunks of a page.
std::uint32_t most_chunks(const std::vector<lod::Page>& pages, std::uint32_t chunk_size);

}  // namespace rgs::detail
