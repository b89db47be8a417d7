// decode.hpp - reads .rgs files: opens a view, reads ranges of Gaussians, validates.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {

/// A caller's bounds for files that it does not trust; more is limit_exceeded.
struct DecodeLimits {
  std::uint64_t max_file_bytes = std::uint64_t{1} << 40;
  std::uint64_t max_gaussians = std::uint64_t{1} << 33;
  /// Compressed data may decode to at most this many times the file's size (plus 1 MiB), which bounds what a small file
  /// makes a reader allocate. The default is DEFLATE's maximum; SceneWriter and the writers of other formats stay below
  /// it for any scene.
  std::uint64_t max_expansion = 1032;
  /// And to at most this many bytes, which bounds what any file makes a reader allocate.
  std::uint64_t max_decoded_bytes = std::uint64_t{1} << 40;

  /// The smaller of both for a file of `file_bytes`.
  std::uint64_t decoded_bytes(std::uint64_t file_bytes) const {
    constexpr std::uint64_t kAlways = std::uint64_t{1} << 20, kMost = ~std::uint64_t{0} - kAlways;
    const bool fits = max_expansion == 0 || file_bytes <= kMost / max_expansion;
    const std::uint64_t expanded = (fits ? file_bytes * max_expansion : kMost) + kAlways;
    return expanded < max_decoded_bytes ? expanded : max_decoded_bytes;
  }
};

/// One Gaussian, ready to render.
struct ActivatedSplat {
  float mean[3];      ///< world units
  float rotation[4];  ///< unit quaternion w, x, y, z
  float scale[3];     ///< standard deviations, world units
  float opacity;      ///< [0, 1]
  float sh[3 * 16];   ///< [16, 3] coefficient-major; unused degrees are 0
};

struct LoadOptions {
  bool validate = true;  ///< as validate(); without it values of a damaged file may be anything, but are safe to read
  unsigned threads = 0;  ///< 0: as many as the machine runs at once
};

/// A range of a file.
struct FileRange {
  std::uint64_t offset = 0, bytes = 0;
};
/// Bytes of a file that are in memory, and their offset in the file.
struct FilePart {
  std::uint64_t offset = 0;
  std::span<const std::byte> bytes;
};

class DirectData;
class FileView;

namespace detail {
struct ArchiveTables;
const ArchiveTables* archive_tables(const FileView& view);
}  // namespace detail

/// An opened file: its parsed head and the caller's bytes, which must outlive the view. Thread-safe to read.
class FileView {
 public:
  /// Parses and checks all but the payload of the large sections, which is not touched, so opening a mapped file reads
  /// a few pages. Safe on untrusted bytes. A file with levels of detail is unsupported_feature: see has_levels() and
  /// PagedFile. Errors: truncated, bad_magic, unsupported_version, reserved_bits, bad_header, bad_section,
  /// section_overlap, section_gap, trailing_bytes, checksum_mismatch, missing_section, duplicate_section,
  /// unknown_required, unsupported_codec, size_mismatch, limit_exceeded, bad_value; the offset says where.
  static Result<FileView> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

  // For readers that fetch a file in pieces and want its head first; for a file with levels of detail see
  // PagedFile::needs(). `size`: bytes of the whole file. `parts`: what is in memory; the first has the file's first
  // bytes.
  /// What open_head() needs besides `parts`: the head, then DECL, PROV and CREF; empty if nothing. A range has at most
  /// 66 KiB. Errors: those of open_head() for the bytes so far.
  static Result<std::vector<FileRange>> head_needs(std::span<const FilePart> parts, std::uint64_t size,
                                                   const DecodeLimits& limits = {});
  /// Header, declarations, provenance and sections; nothing else may be used, since no other bytes are in memory or
  /// checked. `parts` may be freed afterwards. Without PROV there is no provenance(), without CREF no CRS.
  /// Errors: those of open() for what is read; truncated if the head or DECL is missing.
  static Result<FileView> open_head(std::span<const FilePart> parts, std::uint64_t size,
                                    const DecodeLimits& limits = {});

  const Header& header() const { return header_; }
  const Declarations& declarations() const { return declarations_; }
  const std::optional<Provenance>& provenance() const { return provenance_; }
  const std::vector<SectionEntry>& sections() const { return sections_; }
  std::span<const std::byte> bytes() const { return bytes_; }

  const SectionEntry* find(SectionType type) const;
  /// Stored bytes of a section, coded or not; empty if the file has no such section.
  std::span<const std::byte> stored(SectionType type) const;
  std::span<const std::byte> stored(const SectionEntry& entry) const {
    return bytes_.subspan(entry.offset, entry.stored_bytes);
  }
  /// Frames of a section that the file has; none if it is stored as is.
  const FrameTable& frames(SectionType type) const;
  /// Steps and bounds of a file of Profile::archive; otherwise null.
  const ArchiveParameters* archive() const;
  /// Whether a section is coded, so that Gaussians decode a frame at a time.
  bool coded() const;
  /// Offset in the file of byte `byte` of row `row` of a section; of its frame if the section is coded.
  std::uint64_t place(SectionType type, std::uint64_t row, std::uint64_t byte = 0) const;
  /// Decoded bytes of the chunk table [n_chunks, 48] or the SH steps [n_step_sets, 48].
  std::span<const std::byte> chunk_table() const { return table(SectionType::chunks); }
  std::span<const std::byte> step_table() const { return table(SectionType::sh_steps); }

  /// Entry of chunk `i` < n_chunks. Errors: reserved_bits, bad_value, with the offset in the file.
  Result<ChunkEntry> chunk(std::uint64_t i) const;
  /// SH steps `i` < n_step_sets. Errors: bad_value.
  Result<ShStepSet> step_set(std::uint64_t i) const;
  /// SH steps of the Gaussians of chunk `i` < n_chunks. Errors: those of chunk() and step_set().
  Result<ShStepSet> chunk_steps(std::uint64_t i) const;
  /// Position of Gaussian `i` in the source; `i` if the file keeps no permutation.
  std::uint64_t source_index(std::uint64_t i) const;

  /// Gaussians first .. first + out.size() - 1 in the parameters of training. Stored opacities of 0 and 1 and scales of
  /// 0 get finite logits and logarithms that encode to the same codes. In a coded file this decodes every frame with
  /// some of them: read a frame at a time, or from load_direct(). Errors: those of chunk(), step_set() and
  /// read_chunks(); values are not checked otherwise, see validate().
  Status read(std::uint64_t first, std::span<Splat> out) const;
  Status read(std::uint64_t first, std::span<ActivatedSplat> out) const;
  /// Decodes coded sections into memory that this view shares with later copies, for readers of single Gaussians:
  /// read() is then as fast as in a file stored as is. Checks and errors: those of load_direct().
  Status preload(const LoadOptions& options = {});

 private:
  friend class PagedFile;
  friend const detail::ArchiveTables* detail::archive_tables(const FileView& view);
  static Result<FileView> parse_head(std::span<const std::byte> bytes, std::uint64_t size, const DecodeLimits& limits,
                                     bool levels);
  static Result<FileView> parse_front(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits,
                                      bool levels);
  static Result<FileView> parse(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits,
                                bool levels);
  std::span<const std::byte> table(SectionType type) const;
  static std::optional<std::span<const std::byte>> bytes_of(const SectionEntry& entry, std::span<const FilePart> parts);
  Status parse_declarations(std::span<const FilePart> parts);
  Status open_coded(const DecodeLimits& limits);
  Status open_archive(std::span<const std::byte> bytes);

  std::span<const std::byte> bytes_;
  Header header_;
  Declarations declarations_;
  std::optional<Provenance> provenance_;
  std::vector<SectionEntry> sections_;
  std::vector<FrameTable> frames_;  // [sections]; empty if no section is coded
  struct Tables {
    std::vector<std::byte> chunks, scales;
  };
  std::shared_ptr<const Tables> tables_;  // decoded tables, if coded
  std::shared_ptr<const detail::ArchiveTables> archive_;
  std::shared_ptr<const DirectData> preloaded_;  // all attributes, after preload()
};

/// Attributes of consecutive chunks in the layout that a GPU reads, whatever the file's profile: spans over the file's
/// bytes if a section is stored as is, else over decoded bytes in this object. Move-only; the file's bytes must outlive
/// it. Thread-safe to read.
class DirectData {
 public:
  const Header& header() const { return view_.header(); }  ///< of the file
  const FileView& file() const { return view_; }           ///< the view that it was read from
  std::uint64_t first_chunk() const { return first_chunk_; }
  std::uint64_t n_chunks() const { return n_chunks_; }  ///< of this range
  std::uint64_t first() const { return first_; }        ///< first Gaussian
  std::uint64_t size() const { return n_; }             ///< Gaussians

  std::span<const std::byte> means() const { return means_; }        ///< FP32 [size, 3]
  std::span<const std::byte> geometry() const { return geometry_; }  ///< FP16 [size, 8], 16-byte aligned
  std::span<const std::byte> sh() const { return sh_; }              ///< INT8 [size, sh_bytes], 16-byte aligned
  /// Chunk table and SH steps of the whole file: [n_chunks, 48], [n_step_sets, 48] bytes.
  std::span<const std::byte> chunk_table() const { return view_.chunk_table(); }
  std::span<const std::byte> step_table() const { return view_.step_table(); }

  /// As FileView::read(), `first` counted in the file; the range must lie within this one.
  Status read(std::uint64_t first, std::span<Splat> out) const;
  Status read(std::uint64_t first, std::span<ActivatedSplat> out) const;

 private:
  friend Result<DirectData> read_chunks(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                                        const LoadOptions& options);
  static Result<DirectData> load(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                                 const LoadOptions& options);
  struct Free {
    void operator()(std::byte* memory) const;
  };
  FileView view_;
  std::uint64_t first_chunk_ = 0, n_chunks_ = 0, first_ = 0, n_ = 0;
  std::span<const std::byte> means_, geometry_, sh_;
  std::vector<std::unique_ptr<std::byte[], Free>> memory_;
};

/// Chunks first_chunk .. first_chunk + n_chunks - 1 <= n_chunks of the file. Reads only frames with some of them, on
/// all threads. Checks every frame's checksum, but nothing of sections stored as is; with LoadOptions::validate also
/// the values of these Gaussians. Errors: checksum_mismatch, corrupt_data (the offset is the frame's), those of
/// FileView::chunk() and step_set(), bad_value.
Result<DirectData> read_chunks(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                               const LoadOptions& options = {});

/// The whole file, on all threads: with LoadOptions::validate makes all checks of validate(), else those of
/// read_chunks(). Errors: those of read_chunks() and validate().
Result<DirectData> load_direct(const FileView& view, const LoadOptions& options = {});

/// Checks the payload: every checksum, every stored value against its legal range, and tables against what they
/// describe. Then read() cannot fail. Reads the whole file; takes 8 bytes a Gaussian for a permutation, and a few
/// frames for coded sections. Uses all threads.
Status validate(const FileView& view);

namespace detail {
struct ValueTotals;
}

/// validate() in steps, for callers that use what it decodes: begin(), check() with every chunk of the file in order, a
/// range at a time from read_chunks() without LoadOptions::validate, then finish(). The same checks and errors in the
/// same order. Move-only; the view must outlive it.
class Validation {
 public:
  static Result<Validation> begin(const FileView& view);
  /// For decoding a file while it is being received: FileView::open() and begin_early() need the frame tables of the
  /// large sections, check() the frames or rows of its chunks. finish(), with the whole file, compares the sections'
  /// hashes. The same checks, but of several defects another may be found first.
  static Result<Validation> begin_early(const FileView& view);
  Status check(const DirectData& next);
  Status finish() const;
  /// Chunks to read at a time, so that decoded data is never in memory as a whole.
  std::uint64_t chunks_at_a_time() const;

  Validation(Validation&&) noexcept;
  Validation& operator=(Validation&&) noexcept;
  ~Validation();

 private:
  explicit Validation(const FileView& view);
  const FileView* view_;
  std::unique_ptr<detail::ValueTotals> totals_;
  bool hashes_last_ = false;
};

/// FileView::open(), validate() and all Gaussians; of a file with levels of detail PagedFile::open(), validate() and
/// its leaves, or pages_missing.
Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

}  // namespace rgs
