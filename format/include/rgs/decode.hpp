// decode.hpp - reading .rgs files: open a view, read ranges of Gaussians, validate.
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

/// Bounds that a caller puts on files he does not trust; more is limit_exceeded.
struct DecodeLimits {
  std::uint64_t max_file_bytes = std::uint64_t{1} << 40;
  std::uint64_t max_gaussians = std::uint64_t{1} << 33;
  /// What is compressed in a file decodes to at most this many times the file's size (and 1 MiB): what a small file can
  /// make a reader allocate. The default is what DEFLATE cannot exceed; SceneWriter and the writers of other formats
  /// keep to it whatever the scene.
  std::uint64_t max_expansion = 1032;
  /// And to at most this many bytes, whatever its size: what any file can make a reader allocate.
  std::uint64_t max_decoded_bytes = std::uint64_t{1} << 40;

  /// The smaller of the two for a file of `file_bytes`.
  std::uint64_t decoded_bytes(std::uint64_t file_bytes) const {
    constexpr std::uint64_t kAlways = std::uint64_t{1} << 20, kMost = ~std::uint64_t{0} - kAlways;
    const bool fits = max_expansion == 0 || file_bytes <= kMost / max_expansion;
    const std::uint64_t expanded = (fits ? file_bytes * max_expansion : kMost) + kAlways;
    return expanded < max_decoded_bytes ? expanded : max_decoded_bytes;
  }
};

/// One Gaussian as the renderer wants it.
struct ActivatedSplat {
  float mean[3];      ///< world units
  float rotation[4];  ///< unit quaternion w, x, y, z
  float scale[3];     ///< standard deviations, world units
  float opacity;      ///< [0, 1]
  float sh[3 * 16];   ///< [16, 3] coefficient-major; unused degrees are 0
};

struct LoadOptions {
  bool validate = true;  ///< as validate(); without, values of a damaged file may be anything, and are safe to read
  unsigned threads = 0;  ///< 0: as many as the machine runs at once
};

/// A range of a file.
struct FileRange {
  std::uint64_t offset = 0, bytes = 0;
};
/// Bytes of a file that are in memory, and where in the file they are.
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

/// An opened file: its parsed head over the caller's bytes, which must outlive the view. Reading is thread-safe.
class FileView {
 public:
  /// Parses and checks the head of a file: everything but the payload of the large sections, which is not touched, so
  /// that opening a mapped file costs a few pages. Safe on untrusted bytes. A file with levels of detail is
  /// unsupported_feature: PagedFile opens such, see has_levels(). Errors: truncated, bad_magic,
  /// unsupported_version, reserved_bits, bad_header, bad_section, section_overlap, section_gap, trailing_bytes,
  /// checksum_mismatch, missing_section, duplicate_section, unknown_required, unsupported_codec, size_mismatch,
  /// limit_exceeded, bad_value; the offset says where.
  static Result<FileView> open(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

  // For who reads a file in pieces and wants to know what it is before all of it is there; of a file with levels of detail
  // PagedFile::needs(). `size`: bytes of the whole file. `parts` are what is in memory of it; the first has its beginning.
  /// What open_head() needs beyond `parts`: the head, then DECL and PROV. Empty if nothing is. No range is larger than 66 KiB.
  /// Errors: those of open_head() for what is there.
  static Result<std::vector<FileRange>> head_needs(std::span<const FilePart> parts, std::uint64_t size,
                                                   const DecodeLimits& limits = {});
  /// Header, declarations, provenance and sections. Only these may be asked for: no bytes of the file are there, and nothing of
  /// the others has been checked. Nothing of `parts` is needed afterwards. Where only PROV is missing, there is no provenance().
  /// Errors: those of open() for what is read; truncated if the head or DECL is missing.
  static Result<FileView> open_head(std::span<const FilePart> parts, std::uint64_t size,
                                    const DecodeLimits& limits = {});

  const Header& header() const { return header_; }
  const Declarations& declarations() const { return declarations_; }
  const std::optional<Provenance>& provenance() const { return provenance_; }
  const std::vector<SectionEntry>& sections() const { return sections_; }
  std::span<const std::byte> bytes() const { return bytes_; }

  const SectionEntry* find(SectionType type) const;
  /// Stored bytes of a section, coded or not; empty if the file has none of that type.
  std::span<const std::byte> stored(SectionType type) const;
  std::span<const std::byte> stored(const SectionEntry& entry) const {
    return bytes_.subspan(entry.offset, entry.stored_bytes);
  }
  /// Frames of a section of a type that the file has; none if it is stored as is.
  const FrameTable& frames(SectionType type) const;
  /// Steps and bounds of a file of Profile::archive; null for others.
  const ArchiveParameters* archive() const;
  /// Some section is coded: its Gaussians are decoded a frame at a time.
  bool coded() const;
  /// Where byte `byte` of row `row` of a section is in the file: itself if the section is stored as is, else its frame.
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
  /// Position in the source of Gaussian `i`; `i` itself if the file keeps no permutation.
  std::uint64_t source_index(std::uint64_t i) const;

  /// Gaussians first .. first + out.size() - 1 in the parameters of training. Stored opacities of 0 and 1 and scales of
  /// 0 get finite logits and logarithms that encode to the same codes again. In a coded file this decodes every frame
  /// that has some of them: read a frame at a time, or from load_direct().
  /// Errors: those of chunk(), step_set() and read_chunks(); values are not checked otherwise, see validate().
  Status read(std::uint64_t first, std::span<Splat> out) const;
  Status read(std::uint64_t first, std::span<ActivatedSplat> out) const;
  /// Decodes what is coded into memory that this view shares with copies made from now on, for readers of single
  /// Gaussians: read() then costs what it does in a file stored as is. Checks and errors: those of load_direct().
  Status preload(const LoadOptions& options = {});

 private:
  friend class PagedFile;
  friend const detail::ArchiveTables* detail::archive_tables(const FileView& view);
  static Result<FileView> parse_head(std::span<const std::byte> bytes, std::uint64_t size, const DecodeLimits& limits,
                                     bool levels);
  static Result<FileView> parse_front(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits,
                                      bool levels);
  static Result<FileView> parse(std::span<const FilePart> parts, const DecodeLimits& limits, bool levels);
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
  std::shared_ptr<const Tables> tables_;  // what is coded of them, decoded
  std::shared_ptr<const detail::ArchiveTables> archive_;
  std::shared_ptr<const DirectData> preloaded_;  // all attributes, after preload()
};

/// Attributes of consecutive chunks in the layout that a GPU reads, whatever the profile of the file: spans over the
/// file's bytes where a section is stored as is, over memory of this object where it had to be decoded. Move-only; the
/// file's bytes must outlive it. Reading is thread-safe.
class DirectData {
 public:
  const Header& header() const { return view_.header(); }  ///< of the file
  const FileView& file() const { return view_; }           ///< the view that it comes from
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

/// Chunks first_chunk .. first_chunk + n_chunks - 1 <= n_chunks of the file. Only frames that hold some of them are
/// read, on all threads. Every frame's checksum is checked, nothing else of sections that are stored as is; with
/// LoadOptions::validate also the values of these Gaussians. Errors: checksum_mismatch, corrupt_data (the offset is the
/// frame's), those of FileView::chunk() and step_set(), bad_value.
Result<DirectData> read_chunks(const FileView& view, std::uint64_t first_chunk, std::uint64_t n_chunks,
                               const LoadOptions& options = {});

/// The whole file: with LoadOptions::validate all that validate() checks, on all threads; without, what read_chunks()
/// checks. Errors: those of read_chunks() and validate().
Result<DirectData> load_direct(const FileView& view, const LoadOptions& options = {});

/// Checks the payload: every checksum, every stored value against its legal range, tables against what they describe.
/// After success read() cannot fail. Reads the whole file; takes 8 bytes a Gaussian if there is a permutation, and a
/// few frames of memory if sections are coded. Uses all threads.
Status validate(const FileView& view);

namespace detail {
struct ValueTotals;
}

/// validate() in steps, for callers that use what it decodes: begin(), check() with every chunk of the file in order, a
/// range at a time from read_chunks() without LoadOptions::validate, then finish(). Same checks, same errors, same order.
/// Move-only; the view must outlive it.
class Validation {
 public:
  static Result<Validation> begin(const FileView& view);
  /// For who decodes a file while it comes: of the large sections FileView::open() and begin_early() need the frame tables, and
  /// check() the frames or rows of its chunks. finish(), by when all is there, compares the hashes of sections. The same checks,
  /// but of several defects another one may be found first.
  static Result<Validation> begin_early(const FileView& view);
  Status check(const DirectData& next);
  Status finish() const;
  /// Chunks to read at a time, so that what is coded is never in memory as a whole.
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

/// FileView::open(), validate() and all Gaussians in memory; of a file with levels of detail PagedFile::open(), validate()
/// and its leaves, with pages_missing if some of them are.
Result<SplatCloud> decode(std::span<const std::byte> bytes, const DecodeLimits& limits = {});

}  // namespace rgs
