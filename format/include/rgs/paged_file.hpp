// paged_file.hpp - reading files with levels of detail: the tree of pages, pages, levels, all Gaussians of the finest.
// docs/format/FORMAT.md "Levels of detail".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/layout.hpp"
#include "rgs/page.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// Whether the head of a file speaks of levels of detail, so that PagedFile is what opens it. Looks at the head alone and
/// checks nothing of it; false for what is no .rgs file.
bool has_levels(std::span<const std::byte> bytes);
/// Whether it names a section of that type. Looks at the head alone as well.
bool names_section(std::span<const std::byte> bytes, SectionType type);
/// Most that opening a file makes of its section ARCH, which is in memory_bytes() then.
inline constexpr std::uint64_t kMostArchiveMemory = 2 << 20;

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

namespace detail {
/// Content of section LODS, or its beginning.
struct PageTable {
  std::uint32_t n_pages = 0, n_levels = 0;  ///< as read: of the whole
  std::uint32_t page_chunks = 0;
  std::uint64_t n_stored = 0;
  float quality_db = 0;
  std::vector<lod::Page> pages;
  std::vector<StoredPage> stored;
};
}  // namespace detail

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

/// An opened file with levels of detail, or the beginning of one. Reading is thread-safe; extend() and reserve() are not to run
/// beside anything else, PageDecoder included.
class PagedFile {
 public:
  /// Parses and checks the head and the tree of pages, and touches no page. Of `bytes`, pages may be missing at the end, even
  /// all of them: `bytes` must reach to the first page at least. They must outlive the PagedFile. Safe on untrusted bytes.
  /// Errors: those of FileView::open(); missing_section for a file without levels.
  static Result<PagedFile> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

  // For who reads a file in pieces. The table of pages, 112 bytes a page, is coarse to fine as pages are: its beginning is
  // enough to draw from, and may be read before the rest of it. `parts` are what is in memory of the file; the first has the
  // file's beginning. Nothing of them is needed once a function returns.
  //
  //   parts = {0, the first 64 KiB}
  //   while (PagedFile::needs(parts) is not empty) read these ranges, append them to parts
  //   file = PagedFile::open_beginning(parts)
  //   read stored(0), decode page 0, draw
  //   while (file.unread_table().bytes != 0) read some of it, file.extend()

  /// What open_beginning() needs beyond `parts`, in the order of the file, each range to be read as one part: the head; then DECL,
  /// ARCH, and LODS up to its first record. Files of our writers begin with head, DECL and LODS; ARCH is behind LODS. Empty if
  /// nothing is. No range is larger than 1 MiB. Errors: those of open_beginning() for what is there.
  static Result<std::vector<FileRange>> needs(std::span<const FilePart> parts, const DecodeLimits& limits = {});
  /// Opens a file of which bytes() are not in memory: no page is present, pages are read where stored() says and decoded by
  /// PageDecoder. Of the table those pages are known whose records are in `parts` as a whole, at least the root; all that open()
  /// checks is checked of them, but for the hash of LODS: see is_verified(). Pages beyond the file's real size are the caller's to
  /// notice: see n_within(). Errors: those of open(); truncated if needs() is not empty; limit_exceeded for an ARCH of more
  /// than 1 MiB.
  static Result<PagedFile> open_beginning(std::span<const FilePart> parts, const DecodeLimits& limits = {});
  /// More of the table: pages whose records are now there as a whole are known from here on, those known before keep their
  /// numbers and values. `part` must not begin behind unread_table().offset; what it has before that or behind the table is
  /// not looked at. Takes time by what is new. With the last page the hash of LODS is compared, and what only the whole table shows is
  /// checked. After an error the same pages are known as before, and every later call gives that error. Errors: bad_argument (bytes
  /// between are missing; another call may bring them); those of open() for LODS, checksum_mismatch at its start.
  Status extend(const FilePart& part);
  /// What extend() has not had yet; 0 bytes: nothing.
  FileRange unread_table() const;
  /// Takes the memory for all pages at once: extend() then allocates nothing, and pages() stays where it is. Otherwise memory
  /// grows with what has come, to no more than twice of it, and while it grows old and new are held side by side.
  Status reserve();
  /// All pages are known and the hash of LODS has been compared. Always after open().
  bool is_verified() const { return !unread_; }
  /// Bytes that it holds, without those of open(): 120 a page, the tables of an archive, itself.
  std::uint64_t memory_bytes() const;
  /// What that becomes once all pages are known, of which the head of LODS says how many. To be compared with what there is to
  /// spend before reserve(): the head may say anything.
  std::uint64_t whole_memory_bytes() const;

  /// Header, declarations, provenance, sections, archive parameters. Header and declarations speak of the leaves, as those of
  /// a file without levels do. Its functions that read Gaussians or chunks must not be called: there are none outside pages;
  /// after open_beginning() nor those that give bytes of the file, which is not there.
  const FileView& head() const { return head_; }
  const std::vector<lod::Page>& pages() const { return table_.pages; }  ///< that are known; after open() all
  const StoredPage& stored(std::uint32_t page) const { return table_.stored[page]; }
  std::uint32_t n_pages() const { return static_cast<std::uint32_t>(table_.pages.size()); }  ///< that are known
  std::uint32_t n_pages_in_all() const { return table_.n_pages; }  ///< also of those that are not
  std::uint32_t n_levels() const { return table_.pages.front().level + 1; }
  std::uint64_t n_stored() const { return table_.n_stored; }        ///< Gaussians of all pages
  std::uint32_t page_chunks() const { return table_.page_chunks; }  ///< no page has more
  float quality_db() const { return table_.quality_db; }            ///< see lod::Levels
  Codec codec() const { return codec_; }                            ///< of all pages

  /// Pages 0 .. n_present() - 1 are there as a whole. All of them, unless the end of the file is missing.
  std::uint32_t n_present() const { return n_within(head_.bytes().size()); }
  /// Known pages that lie within the first `file_bytes` bytes of the file.
  std::uint32_t n_within(std::uint64_t file_bytes) const;
  /// Nothing is missing at the end.
  bool complete() const { return head_.bytes().size() == head_.header().file_bytes; }
  /// The finest level of which all pages are there; n_levels() if not even the root is.
  std::uint32_t finest_present() const;

  std::uint64_t decoded_bytes(std::uint32_t page) const;
  std::uint64_t largest_decoded_bytes() const;  ///< of all known pages
  /// No page decodes to more, known or not, by what LODS says of them all.
  std::uint64_t most_decoded_bytes() const;
  /// Stored bytes of a page that is present.
  std::span<const std::byte> bytes(std::uint32_t page) const;
  /// Decoded bytes [decoded_bytes(page)] as arrays.
  PageRows rows(std::uint32_t page, std::span<const std::byte> decoded) const;
  /// Position in the source of Gaussian `i` of the leaves; `i` itself if the file keeps none, or they are missing.
  std::uint64_t source_index(std::uint64_t i) const;
  bool has_source_index() const;

 private:
  static Result<PagedFile> parse(std::span<const std::byte> bytes, const DecodeLimits& limits);
  static Result<PagedFile> parse_beginning(std::span<const FilePart> parts, const DecodeLimits& limits);
  Status read_records(std::span<const std::byte> records);
  FileView head_;
  detail::PageTable table_;
  Codec codec_ = Codec::none;
  // Until the whole table has been read.
  struct Unread {
    Hasher hash;  // of what has
    Status failed;
  };
  std::optional<Unread> unread_;
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
