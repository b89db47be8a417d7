// stream_levels.hpp - a scene of any size to a file with levels, in bounded memory.
// SPDX-License-Identifier: Apache-2.0
//
// The steps, each over ranges that know nothing of each other, so that other processes may run their parts:
//   order_leaves()  Gaussians go to ranges of the Morton curve in a scratch file; each range is sorted by itself.
//   build_upper()   Leaf pages are cut, and groups of them simplified, level by level; each level is a scratch file.
//   write_tree()    Pages are written coarse to fine.
// Ranges depend on the memory that there is, and nothing that is written depends on ranges.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "build_levels.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/spatial_order.hpp"
#include "scratch_file.hpp"

namespace rgs::lod {

/// A scene that is read several times, the same Gaussians in the same order each time.
struct SplatStream {
  /// Receives consecutive Gaussians, `first` being the position of the first one.
  using Visit = std::function<Status(std::uint64_t first, std::span<const Splat> rows)>;

  std::uint64_t n = 0;
  int sh_degree = 0;
  /// Calls `visit` until it has had all Gaussians or fails.
  std::function<Status(const Visit& visit)> read;
};

inline constexpr std::uint64_t kDefaultMemory = std::uint64_t{2} << 30;
inline constexpr std::uint64_t kLeastMemory = std::uint64_t{128} << 20;

struct StreamOptions {
  BuildOptions build;                           ///< but chunk_size, which is the file's
  std::uint64_t memory_bytes = kDefaultMemory;  ///< at least kLeastMemory
  std::string scratch;                          ///< folder; used where less than half of memory_bytes does not suffice
  /// How far a stage is: see StageObserver of the conversion.
  std::function<void(const char* stage, std::uint64_t total, const char* unit)> begin = [](auto...) {};
  std::function<void(std::uint64_t units)> advance = [](auto...) {};
};

/// Gaussians of one level, one after the other, in a scratch file. Leaves are kept as they are, and may know their positions in
/// the source; harmonics of other levels are FP16 numbers (see append()).
class LevelRows {
 public:
  enum class Kind : std::uint8_t { leaves, leaves_with_positions, upper };
  LevelRows(ScratchFile file, int sh_degree, Kind kind) : file_(std::move(file)), sh_degree_(sh_degree), kind_(kind) {}

  std::uint64_t row_bytes() const;
  int sh_degree() const { return sh_degree_; }
  ScratchFile& file() { return file_; }
  void pack(const Splat& splat, std::uint32_t position, std::byte* row) const;
  /// Rows [n * row_bytes()] as a cloud, which is set.
  void unpack(std::span<const std::byte> rows, SplatCloud& out) const;
  std::uint32_t position(const std::byte* row) const;
  /// Errors: ScratchFile's.
  Status write(std::uint64_t first, const SplatView& splats);
  Status read(std::uint64_t first, std::uint64_t n, SplatCloud& out) const;

 private:
  ScratchFile file_;
  int sh_degree_;
  Kind kind_;
};

/// What a file with levels is written from.
struct StreamedLevels {
  std::vector<LevelRows> rows;           // leaves first
  std::vector<std::vector<Page>> pages;  // of each level, Page::first counted within it
  std::vector<ChunkBoxes> chunks;        // of the leaves, until pages are cut
  std::vector<std::uint32_t> positions;  // of the leaves in the source, if asked for
  std::uint64_t n_leaves = 0;
  bool on_disk = false;  // scratch files are files
  std::uint64_t n_stored() const;
};

/// Calls visit(position of each in the source, the kept rows as they are mended) for blocks of the stream.
using VisitKept = std::function<Status(std::span<const std::uint32_t> positions, std::span<const Splat> rows)>;
Status each_kept(const SplatStream& stream, int sh_degree, BadPolicy on_bad, const VisitKept& visit);
/// Morton keys of all means.
std::vector<std::uint64_t> keys_of(std::span<const Splat> rows, const MortonKey& key);
/// Brings rows of `row_bytes`, which begin with their means, into the order of the curve; equal keys stay as they come.
/// Memory: the rows again and 24 bytes of each.
void sort_rows(std::vector<std::byte>& rows, std::uint64_t row_bytes, const MortonKey& key);
/// Adds rows first ... of the leaves to the boxes of their chunks.
void add_to_chunks(const LevelRows& leaves, std::uint64_t first, std::span<const std::byte> rows,
                   std::uint64_t chunk_size, std::vector<ChunkBoxes>& chunks);
/// Bytes of a row that, twice and with its key, is in memory while it is sorted.
constexpr std::uint64_t sorting_bytes(std::uint64_t row_bytes) {
  return 2 * row_bytes + 24;
}

/// First pass: what there is to know of the scene. `first_damaged`: the position of the first Gaussian that is not kept or was
/// mended, Error::kNone if there is none.
Status scan_stream(const SplatStream& stream, const StreamOptions& options, SceneScan& scan,
                   std::uint64_t& first_damaged);
/// Means of at most `most` kept Gaussians, evenly spread.
Status sample_means(const SplatStream& stream, const StreamOptions& options, const SceneScan& scan, BadPolicy on_bad,
                    std::uint64_t most, std::vector<float>& means);

/// `scan` is that of the same stream. Errors of all: the stream's, ScratchFile's; read_failed (the source changed);
/// limit_exceeded (so many Gaussians are near each other that they cannot be sorted in this memory).
Status order_leaves(const SplatStream& stream, const SceneScan& scan, const EncodeOptions& encode,
                    const StreamOptions& options, StreamedLevels& out);
/// Up to one page, or to level `last`.
Status build_upper(const EncodeOptions& encode, const StreamOptions& options, StreamedLevels& out,
                   std::uint32_t last = kMaxLevels);
/// The same, where the pages of some level are there: out.rows.back() and out.pages.back(), a page or more. `stretches`: where
/// stretches begin among these, see cut_leaf_pages().
Status build_above(const EncodeOptions& encode, const StreamOptions& options, std::vector<std::uint32_t> stretches,
                   StreamedLevels& out, std::uint32_t last = kMaxLevels);
/// What levels are built with for a file with these options.
BuildOptions build_options(const EncodeOptions& encode, const StreamOptions& options);
/// As write_tree() passes them on: what the scan says of the source, and `positions` of the leaves if they are asked for.
EncodeOptions file_options(const SceneScan& scan, const EncodeOptions& encode,
                           std::span<const std::uint32_t> positions);
/// At most `at_once` of n jobs at a time, none after one that fails; the first failure.
Status each_at_once(std::size_t n, std::uint64_t at_once, const std::function<Status(std::size_t i)>& job);
/// Jobs that take so many bytes each and fit into a quarter of the memory, at least one and at most as many as threads.
std::uint64_t most_at_once(const StreamOptions& options, std::uint64_t bytes_each);
/// On the disk, or in memory.
Result<ScratchFile> scratch_file(bool on_disk, const StreamOptions& options);
inline constexpr std::uint64_t kPageBytes = std::uint64_t{4} << 20;  ///< that a page takes while it is encoded
/// Errors: LevelsWriter's too.
Result<WrittenScene> write_tree(const StreamedLevels& levels, const SceneScan& scan, const EncodeOptions& encode,
                                const StreamOptions& options, Sink sink);

}  // namespace rgs::lod
