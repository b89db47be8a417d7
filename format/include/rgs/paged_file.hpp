// paged_file.hpp - reading files with levels of detail: the tree of pages, pages, levels, all Gaussians of the finest.
// docs/FORMAT.md "Levels of detail".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/layout.hpp"
#include "rgs/page.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// Whether the head of a file speaks of levels of detail, so that PagedFile is what opens it. Looks at the head alone and
/// checks nothing of it; false for what is no .rgs file.
bool has_levels(std::span<const std::byte> bytes);

/// How a page lies in its file.
struct StoredPage {
  std::uint64_t offset = 0;  ///< in the file
  std::uint64_t xxh3 = 0;    ///< XXH3-64, seed 0, of the stored bytes
  std::uint32_t stored_bytes = 0;
  std::uint32_t n_step_sets = 0;    ///< 1, or one a chunk
  std::int16_t scale_exponent = 0;  ///< stored scale = scale * 2^scale_exponent, of this page's Gaussians
  /// Codec::archive: smallest grid coordinate on each axis, which those in the page are relative to.
  std::array<std::uint32_t, 3> corner{};
};

/// Decoded Gaussians of one page, in the layout that a GPU reads: spans over memory of the caller, each 16-byte aligned if
/// that is.
struct PageRows {
  std::uint32_t n = 0;                  ///< Gaussians
  int scale_exponent = 0;               ///< of `geometry`
  std::span<const std::byte> chunks;    ///< ChunkEntry records [n_chunks, 48]; step_set counts in `steps`
  std::span<const std::byte> steps;     ///< FP32 [n_step_sets, 4, 3]
  std::span<const std::byte> means;     ///< FP32 [n, 3]
  std::span<const std::byte> geometry;  ///< FP16 [n, 8]
  std::span<const std::byte> sh;        ///< INT8 [n, sh_bytes]
};

/// An opened file with levels of detail, or the beginning of one. Its bytes must outlive it. Reading is thread-safe.
class PagedFile {
 public:
  /// Parses and checks the head and the tree of pages, and touches no page. Of `bytes`, pages may be missing at the end, even
  /// all of them: `bytes` must reach to the first page at least. Safe on untrusted bytes. Errors: those of FileView::open();
  /// missing_section for a file without levels.
  static Result<PagedFile> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

  /// Header, declarations, provenance, sections, archive parameters. Header and declarations speak of the leaves, as those of
  /// a file without levels do. Its functions that read Gaussians or chunks must not be called: there are none outside pages.
  const FileView& head() const { return head_; }
  const std::vector<lod::Page>& pages() const { return pages_; }
  const StoredPage& stored(std::uint32_t page) const { return stored_[page]; }
  std::uint32_t n_pages() const { return static_cast<std::uint32_t>(pages_.size()); }
  std::uint32_t n_levels() const { return pages_.front().level + 1; }
  std::uint64_t n_stored() const { return n_stored_; }        ///< Gaussians of all pages
  std::uint32_t page_chunks() const { return page_chunks_; }  ///< no page has more
  float quality_db() const { return quality_db_; }            ///< see lod::Levels
  Codec codec() const { return codec_; }                      ///< of all pages

  /// Pages 0 .. n_present() - 1 are there as a whole. All of them, unless the end of the file is missing.
  std::uint32_t n_present() const;
  /// Nothing is missing at the end.
  bool complete() const { return head_.bytes().size() == head_.header().file_bytes; }
  /// The finest level of which all pages are there; n_levels() if not even the root is.
  std::uint32_t finest_present() const;

  std::uint64_t decoded_bytes(std::uint32_t page) const;
  std::uint64_t largest_decoded_bytes() const;
  /// Stored bytes of a page that is present.
  std::span<const std::byte> bytes(std::uint32_t page) const;
  /// Decoded bytes [decoded_bytes(page)] as arrays.
  PageRows rows(std::uint32_t page, std::span<const std::byte> decoded) const;
  /// Position in the source of Gaussian `i` of the leaves; `i` itself if the file keeps none, or they are missing.
  std::uint64_t source_index(std::uint64_t i) const;
  bool has_source_index() const;

 private:
  static Result<PagedFile> parse(std::span<const std::byte> bytes, const DecodeLimits& limits);
  FileView head_;
  std::vector<lod::Page> pages_;
  std::vector<StoredPage> stored_;
  std::uint64_t n_stored_ = 0;
  std::uint32_t page_chunks_ = 0;
  float quality_db_ = 0;
  Codec codec_ = Codec::none;
};

/// Decodes pages, one at a time; starts no threads and maps no files. Keeps its memory from one page to the next.
class PageDecoder {
 public:
  /// `file` must outlive it.
  explicit PageDecoder(const PagedFile& file);
  PageDecoder(PageDecoder&&) noexcept;
  PageDecoder& operator=(PageDecoder&&) noexcept;
  ~PageDecoder();

  /// Page `page` from its stored bytes, wherever they come from, to `out` [decoded_bytes(page)]. The hash is checked first.
  /// Safe on untrusted bytes: values may then be anything, and are safe to read; see check_page_values(). Errors:
  /// size_mismatch, checksum_mismatch, corrupt_data at the page's place in the file; host_out_of_memory.
  Result<PageRows> decode(std::uint32_t page, std::span<const std::byte> stored, std::span<std::byte> out);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

/// Every value of a decoded page against its legal range, its chunks' entries and the page's box. After success it can be
/// drawn. Errors: those of validate() for such values, at the value's place, or the page's where it is coded.
Status check_page_values(const PagedFile& file, std::uint32_t page, const PageRows& rows);

/// Gaussians first .. first + out.size() - 1 of a decoded page, as FileView::read() gives them. Errors: bad_value (chunks or
/// steps that are not legal).
Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<Splat> out);
Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<ActivatedSplat> out);

/// All Gaussians of these pages, one page after the other. With LoadOptions::validate their values are checked. Errors:
/// pages_missing (one is not present), those of PageDecoder and check_page_values().
Result<SplatCloud> read_pages(const PagedFile& file, std::span<const std::uint32_t> pages,
                              const LoadOptions& options = {});

/// The leaves as a file of Profile::direct without levels, in memory: the same Gaussians, chunks, steps, declarations,
/// provenance and positions, for what reads such files alone. Positions and provenance that are missing at the end of the file
/// are left out. Errors: those of read_pages(); checksum_mismatch (positions).
Result<std::vector<std::byte>> leaves_as_file(const PagedFile& file, const LoadOptions& options = {});

/// Checks all that validate() checks of a file without levels, of every page, and that pages hold what their boxes say. Of
/// an incomplete file what is there. Errors: those of validate().
Status validate(const PagedFile& file, unsigned threads = 0);

}  // namespace rgs
