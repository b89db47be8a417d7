// paged_file.hpp - reads files with levels of detail: the tree of pages, pages, levels, all Gaussians of the finest
// level. docs/format/FORMAT.md "Levels of detail".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/layout.hpp"
#include "rgs/page.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// Whether the head declares levels of detail, so that PagedFile opens the file. Reads the head alone and checks
/// nothing; false for other files.
bool has_levels(std::span<const std::byte> bytes);
/// Whether the head names a section of that type; likewise.
bool names_section(std::span<const std::byte> bytes, SectionType type);
/// Most memory for an opened ARCH section, part of memory_bytes().
inline constexpr std::uint64_t kMostArchiveMemory = 2 << 20;

/// Where and how a page is stored.
struct StoredPage {
  std::uint64_t offset = 0;  ///< in the file
  std::uint64_t xxh3 = 0;    ///< XXH3-64, seed 0, of the stored bytes
  std::uint32_t stored_bytes = 0;
  std::uint32_t n_step_sets = 0;    ///< 1, or one a chunk
  std::int16_t scale_exponent = 0;  ///< stored scale = scale * 2^scale_exponent for this page
  std::uint16_t n_origins = 0;      ///< see PageOrigin
  /// Codec::archive: smallest grid coordinate on each axis, subtracted from the page's.
  std::array<std::uint32_t, 3> corner{};
};

/// Means of a page from row `first` on are stored relative to the file's origin + `offset`, those of a page without
/// PageOrigins relative to the file's origin.
struct PageOrigin {
  std::uint32_t first = 0;
  std::array<float, 3> offset{};
};

namespace detail {
/// Section LODS, or parts of it. Pages beyond `pages` and those without Gaussians are unknown.
struct PageTable {
  std::uint32_t n_pages = 0, n_levels = 0;  ///< as read: of the whole file
  std::uint32_t page_chunks = 0;
  std::uint32_t n_ordered = 0;  // pages before the first unknown one
  std::uint64_t n_stored = 0;
  float quality_db = 0;
  std::vector<lod::Page> pages;
  std::vector<StoredPage> stored;
  bool is_known(std::size_t page) const { return page < pages.size() && pages[page].count != 0; }
};
}  // namespace detail

/// A page's decoded Gaussians in the layout that a GPU reads: spans over the caller's memory, 16-byte aligned if that
/// is.
struct PageRows {
  std::uint32_t n = 0;                  ///< Gaussians
  int scale_exponent = 0;               ///< of `geometry`
  std::span<const std::byte> chunks;    ///< ChunkEntry records [n_chunks, 48]; step_set is an index into `steps`
  std::span<const std::byte> steps;     ///< FP32 [n_step_sets, 4, 3]
  std::span<const std::byte> means;     ///< FP32 [n, 3]
  std::span<const std::byte> geometry;  ///< FP16 [n, 8]
  std::span<const std::byte> sh;        ///< INT8 [n, sh_bytes]
};

/// An opened file with levels of detail, or a part of one. Thread-safe to read; reserve(), and extend() without it, must
/// not run beside anything else, PageDecoder included. After reserve(), extend() may run beside readers of known pages.
class PagedFile {
 public:
  /// Parses and checks the head and the tree of pages, and touches no page. `bytes` may end early, but not before the
  /// first page, and must outlive the PagedFile. Safe on untrusted bytes. Errors: those of FileView::open();
  /// missing_section for a file without levels.
  static Result<PagedFile> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

  // For reading a file in pieces. The table of pages, 112 bytes a page, is coarse to fine as the pages are: its beginning
  // suffices to draw, and the rest is read where it is wanted. `parts`: what is in memory of the file; the first has the file's
  // first bytes. They may be freed after each call. `size`: bytes of the whole file, if known; else bytes behind the
  // end that the header states are not noticed.
  //
  //   parts = {0, the first 64 KiB}
  //   while (PagedFile::needs(parts) is not empty) read these ranges, append them to parts
  //   file = PagedFile::open_beginning(parts)
  //   read stored(0), decode page 0, draw
  //   while (file.unread_table().bytes != 0) read some of it, file.extend()
  //
  // Or after file.reserve(), wherever children of a known page are wanted: read some of file.unread_table(page), then
  // file.extend(part, page).

  /// What open_beginning() needs besides `parts`, in file order, each range to be read as one part: the head; then
  /// DECL, ARCH, and LODS up to its first record; empty if nothing. Our writers put head, DECL and LODS first, and ARCH
  /// behind LODS. A range has at most 1 MiB. Errors: those of open_beginning() for the bytes so far.
  static Result<std::vector<FileRange>> needs(std::span<const FilePart> parts, const DecodeLimits& limits = {},
                                              std::optional<std::uint64_t> size = {});
  /// Opens a file without its bytes(): no page is present; read pages at stored() and decode them with PageDecoder.
  /// Pages whose records are complete in `parts`, at least the root, are known and have passed open()'s checks, except,
  /// unless one part holds all of LODS, its hash: see is_verified(). The caller must notice pages beyond the file's real size: see n_within().
  /// Errors: those of open(); truncated if needs() is not empty; limit_exceeded for an ARCH of more than 1 MiB.
  static Result<PagedFile> open_beginning(std::span<const FilePart> parts, const DecodeLimits& limits = {},
                                          std::optional<std::uint64_t> size = {});
  /// Adds more of the table: pages whose records are now complete become known; known ones keep their numbers and
  /// values. `part` must start at or before unread_table(below).offset; bytes before that, from the next known page on
  /// and from the first page on whose parent is unknown are ignored. Takes time in proportion to the new bytes. The last
  /// page completes the hash of LODS and the checks of the whole table. After an error the same pages are known as
  /// before; a later call may bring the right bytes. Errors: bad_argument (bytes in between are missing); those of
  /// open() for LODS, checksum_mismatch at its start.
  Status extend(const FilePart& part, std::uint32_t below = lod::kNoPage);
  /// The part of the table, of at most `most` bytes, that extend() needs next: from the first unknown child of the known
  /// page `below`, or from the first unknown page, up to a known one; 0 bytes: none.
  FileRange unread_table(std::uint32_t below = lod::kNoPage, std::uint64_t most = ~std::uint64_t{0}) const;
  /// Allocates for all pages at once: pages() and stored() then have them all, at addresses that stay; unknown ones have
  /// 0 Gaussians. Otherwise memory grows as pages become known, up to twice their size, and briefly holds old and new
  /// side by side.
  Status reserve();
  /// All pages are known and the hash of LODS is verified. Always after open().
  bool is_verified() const { return is_verified_; }
  /// Bytes held, without those of open(): 120 a page, the tables of an archive, itself.
  std::uint64_t memory_bytes() const;
  /// The same once all pages are known, by the number in the head of LODS. Compare it with your budget before
  /// reserve(): the head may say anything.
  std::uint64_t whole_memory_bytes() const;

  /// Header, declarations, provenance, sections, archive parameters; header and declarations describe the leaves, as in
  /// a file without levels. Do not call its functions that read Gaussians or chunks, which exist in pages alone; after
  /// open_beginning() nor those that return bytes of the file.
  const FileView& head() const { return head_; }
  const std::vector<lod::Page>& pages() const { return table_.pages; }
  const StoredPage& stored(std::uint32_t page) const { return table_.stored[page]; }
  std::uint32_t n_pages() const { return table_.n_ordered; }       ///< before the first unknown one; after open() all
  std::uint32_t n_pages_in_all() const { return table_.n_pages; }  ///< with the unknown ones
  std::uint32_t n_levels() const { return table_.pages.front().level + 1; }
  std::uint64_t n_stored() const { return table_.n_stored; }        ///< Gaussians of all pages
  std::uint32_t page_chunks() const { return table_.page_chunks; }  ///< most of a page
  float quality_db() const { return table_.quality_db; }            ///< see lod::Levels
  std::uint32_t n_pages_with_origins() const;                       ///< known ones that have PageOrigins
  Codec codec() const { return codec_; }                            ///< of all pages

  /// Pages 0 .. n_present() - 1 are complete. All are, unless the end of the file is missing.
  std::uint32_t n_present() const { return n_within(head_.bytes().size()); }
  /// The same within the first `file_bytes` bytes of the file.
  std::uint32_t n_within(std::uint64_t file_bytes) const;
  /// The file's end is not missing.
  bool complete() const { return head_.bytes().size() == head_.header().file_bytes; }
  /// The finest level whose pages are all present; n_levels() if not even the root is.
  std::uint32_t finest_present() const;

  std::uint64_t decoded_bytes(std::uint32_t page) const;
  std::uint64_t largest_decoded_bytes() const;  ///< of pages 0 .. n_pages() - 1
  /// Upper bound for all pages, known or not, by LODS.
  std::uint64_t most_decoded_bytes() const;
  /// Stored bytes of a present page.
  std::span<const std::byte> bytes(std::uint32_t page) const;
  /// Decoded bytes [decoded_bytes(page)] as arrays.
  PageRows rows(std::uint32_t page, std::span<const std::byte> decoded) const;
  /// Position in the source of the leaves' Gaussian `i`; `i` if the file has no positions, or they are missing.
  std::uint64_t source_index(std::uint64_t i) const;
  bool has_source_index() const;

 private:
  static Result<PagedFile> parse(std::span<const std::byte> bytes, const DecodeLimits& limits);
  static Result<PagedFile> parse_beginning(std::span<const FilePart> parts, const DecodeLimits& limits,
                                           std::optional<std::uint64_t> size);
  Status read_table(std::span<const std::byte> section, const DecodeLimits& limits);
  FileView head_;
  detail::PageTable table_;
  Codec codec_ = Codec::none;
  bool is_verified_ = false;
};

/// Decodes pages, one at a time, reusing its memory; starts no threads and maps no files.
class PageDecoder {
 public:
  /// `file` must outlive it.
  explicit PageDecoder(const PagedFile& file);
  PageDecoder(PageDecoder&&) noexcept;
  PageDecoder& operator=(PageDecoder&&) noexcept;
  ~PageDecoder();

  /// Decodes page `page` from its stored bytes, whatever their source, to `out` [decoded_bytes(page)]. Checks the hash
  /// first. Safe on untrusted bytes: values may then be anything, and are safe to read; see check_page_values().
  /// Means are rounded to FP32 relative to the file's origin; `rests` gets what that rounds off, [n, 3] as
  /// Splat::mean_rest, of a page with origins of its own (PageOrigin), and nothing of others. Errors: size_mismatch,
  /// checksum_mismatch, corrupt_data at the page's offset; host_out_of_memory.
  Result<PageRows> decode(std::uint32_t page, std::span<const std::byte> stored, std::span<std::byte> out,
                          std::vector<float>* rests = nullptr);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

/// Checks every value of a decoded page against its legal range, its chunks' entries and the page's box; it can then be
/// drawn. Errors: those of validate() for such values, at the value's offset, or the page's if it is coded.
Status check_page_values(const PagedFile& file, std::uint32_t page, const PageRows& rows);

/// Gaussians first .. first + out.size() - 1 of a decoded page, as from FileView::read(). Errors: bad_value (illegal
/// chunks or steps).
Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<Splat> out);
Status read_page(const PagedFile& file, std::uint32_t page, const PageRows& rows, std::uint32_t first,
                 std::span<ActivatedSplat> out);

/// All Gaussians of these pages, page after page. With LoadOptions::validate checks their values. Errors: pages_missing
/// (one is absent), those of PageDecoder and check_page_values().
Result<SplatCloud> read_pages(const PagedFile& file, std::span<const std::uint32_t> pages,
                              const LoadOptions& options = {});

/// The leaves as a file of Profile::direct without levels, in memory, for readers of such files: the same Gaussians,
/// chunks, steps, declarations, provenance and positions; the latter two are left out if the end of the file is
/// missing. Errors: those of read_pages(); checksum_mismatch (positions).
Result<std::vector<std::byte>> leaves_as_file(const PagedFile& file, const LoadOptions& options = {});

/// Makes the checks of validate() for every page, and checks that pages lie in their boxes. Of an incomplete file,
/// checks what is present. Errors: those of validate().
Status validate(const PagedFile& file, unsigned threads = 0);

}  // namespace rgs
