// levels_file.hpp - places the sections of a file with levels and writes its head, once its pages are encoded.
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

/// What is known of a page once it is encoded.
struct EncodedPage {
  std::span<const std::byte> bytes;  ///< as stored
  std::uint64_t xxh3 = 0;            ///< of these
  std::uint32_t n_step_sets = 0;
  std::int16_t scale_exponent = 0;
  std::array<std::uint32_t, 3> corner{};
  Box extent;  ///< holds the stored Gaussians out to 3 standard deviations
};

/// Sections in the order DECL, LODS, ARCH, PROV, PAGE, PERM: the sizes of all before the pages are known, and what stands
/// before them is all that a reader needs before it can use the first. All functions give the errors of their sink.
class LevelsFile {
 public:
  /// `archive`: content of ARCH, empty if there is none. `table`: its pages and quality.
  LevelsFile(Sink sink, const EncodePlan& plan, PageTable table, std::span<const std::byte> archive);
  /// The next page. Gaussians above the leaves may have larger boxes once stored: the tree's boxes grow with them.
  Status add(const EncodedPage& page);
  std::size_t n_added() const { return n_added_; }
  const std::vector<lod::Page>& pages() const { return table_.pages; }
  /// Everything but the pages. `positions`: content of PERM, if the plan has it.
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

/// The most chunks of any page.
std::uint32_t most_chunks(const std::vector<lod::Page>& pages, std::uint32_t chunk_size);

}  // namespace rgs::detail
