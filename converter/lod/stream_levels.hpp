// stream_levels.hpp - writes a scene of any size as a file with levels, in bounded memory.
// SPDX-License-Identifier: Apache-2.0
//
// The steps work on independent ranges, so that other processes may run parts:
//   order_leaves()  distributes Gaussians to ranges of the Morton curve in a scratch file and sorts each range.
//   build_upper()   cuts leaf pages and simplifies groups of them, level by level; each level is a scratch file.
//   write_tree()    writes pages coarse to fine.
// Ranges depend on the available memory; the written bytes do not depend on ranges.
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

/// A scene that is read several times: the same Gaussians in the same order each time.
struct SplatStream {
  /// Receives consecutive Gaussians; `first` is the position of the first.
  using Visit = std::function<Status(std::uint64_t first, std::span<const Splat> rows)>;

  std::uint64_t n = 0;
  int sh_degree = 0;
  /// Calls `visit` for all Gaussians in turn, until it fails.
  std::function<Status(const Visit& visit)> read;
};

inline constexpr std::uint64_t kDefaultMemory = std::uint64_t{2} << 30;
inline constexpr std::uint64_t kLeastMemory = std::uint64_t{128} << 20;

struct StreamOptions {
  BuildOptions build;                           ///< except chunk_size, which is the file's
  std::uint64_t memory_bytes = kDefaultMemory;  ///< at least kLeastMemory
  std::string scratch;                          ///< folder; used if half of memory_bytes does not suffice
  /// Progress of a stage: see the conversion's StageObserver.
  std::function<void(const char* stage, std::uint64_t total, const char* unit)> begin = [](auto...) {};
  std::function<void(std::uint64_t units)> advance = [](auto...) {};
};

/// Gaussians of one level in a scratch file. Leaves are unchanged and may carry their positions in the source;
/// harmonics of other levels are FP16 numbers (see append()).
class LevelRows {
 public:
  struct Kind {
    bool is_upper = false, has_positions = false, has_rests = false;  ///< the latter: Splat::mean_rest
    static Kind of_leaves(const EncodeOptions& encode) { return {false, encode.keep_permutation, encode.page_origins}; }
    static constexpr Kind of_upper() { return {true, false, false}; }
  };
  LevelRows(ScratchFile file, int sh_degree, Kind kind) : file_(std::move(file)), sh_degree_(sh_degree), kind_(kind) {}

  std::uint64_t row_bytes() const;
  int sh_degree() const { return sh_degree_; }
  ScratchFile& file() { return file_; }
  void pack(const Splat& splat, std::uint32_t position, std::byte* row) const;
  /// Unpacks rows [n * row_bytes()] into `out`.
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

/// The input of write_tree().
struct StreamedLevels {
  std::vector<LevelRows> rows;           // leaves first
  std::vector<std::vector<Page>> pages;  // per level, Page::first counted within it
  std::vector<ChunkBoxes> chunks;        // of the leaves, until pages are cut
  std::vector<std::uint32_t> positions;  // of the leaves in the source, if requested
  std::uint64_t n_leaves = 0;
  bool on_disk = false;  // whether scratch files are files
  std::uint64_t n_stored() const;
};

/// Calls visit(position of each row in the source, the kept rows after repair) for blocks of the stream.
using VisitKept = std::function<Status(std::span<const std::uint32_t> positions, std::span<const Splat> rows)>;
Status each_kept(const SplatStream& stream, int sh_degree, BadPolicy on_bad, const VisitKept& visit);
/// Morton keys of all means.
std::vector<std::uint64_t> keys_of(std::span<const Splat> rows, const MortonKey& key);
/// Sorts rows of `row_bytes`, which begin with their means and come in the source's order, as sort_by_key() does.
/// Memory: the rows again and 24 bytes each.
void sort_rows(std::vector<std::byte>& rows, std::uint64_t row_bytes, const MortonKey& key);
/// Adds rows of the leaves, from `first` on, to the boxes of their chunks.
void add_to_chunks(const LevelRows& leaves, std::uint64_t first, std::span<const std::byte> rows,
                   std::uint64_t chunk_size, std::vector<ChunkBoxes>& chunks);
/// Memory that sorting takes per row: the row twice, and its key.
constexpr std::uint64_t sorting_bytes(std::uint64_t row_bytes) {
  return 2 * row_bytes + 24;
}

/// First pass: scans the scene. `first_damaged`: position of the first dropped or repaired Gaussian, or Error::kNone.
Status scan_stream(const SplatStream& stream, const StreamOptions& options, SceneScan& scan,
                   std::uint64_t& first_damaged);
/// Means of at most `most` kept Gaussians, evenly spread.
Status sample_means(const SplatStream& stream, const StreamOptions& options, const SceneScan& scan, BadPolicy on_bad,
                    std::uint64_t most, std::vector<float>& means);

/// `scan` is that of the same stream. Errors of all: the stream's, ScratchFile's; read_failed (the source changed);
/// limit_exceeded (too many Gaussians are too close to be sorted in this memory).
Status order_leaves(const SplatStream& stream, const SceneScan& scan, const EncodeOptions& encode,
                    const StreamOptions& options, StreamedLevels& out);
/// Builds levels up to one page, or to level `last`.
Status build_upper(const EncodeOptions& encode, const StreamOptions& options, StreamedLevels& out,
                   std::uint32_t last = kMaxLevels);
/// The same from a level whose pages exist: out.rows.back() and out.pages.back(), at least one page. `stretches`: where
/// stretches begin among these, see cut_leaf_pages().
Status build_above(const EncodeOptions& encode, const StreamOptions& options, std::vector<std::uint32_t> stretches,
                   StreamedLevels& out, std::uint32_t last = kMaxLevels);
/// BuildOptions of a file with these options.
BuildOptions build_options(const EncodeOptions& encode, const StreamOptions& options);
/// Options for write_tree(): with the scan's statistics of the source, and `positions` of the leaves if requested.
EncodeOptions file_options(const SceneScan& scan, const EncodeOptions& encode,
                           std::span<const std::uint32_t> positions);
/// Runs n jobs, at most `at_once` at a time and none after a failure; returns the first failure.
Status each_at_once(std::size_t n, std::uint64_t at_once, const std::function<Status(std::size_t i)>& job);
/// How many jobs of this size fit into a quarter of the memory: at least one, at most one per thread.
std::uint64_t most_at_once(const StreamOptions& options, std::uint64_t bytes_each);
/// On disk or in memory.
Result<ScratchFile> scratch_file(bool on_disk, const StreamOptions& options);
inline constexpr std::uint64_t kPageBytes = std::uint64_t{4} << 20;  ///< of a page while it is encoded
/// Errors: LevelsWriter's too.
Result<WrittenScene> write_tree(const StreamedLevels& levels, const SceneScan& scan, const EncodeOptions& encode,
                                const StreamOptions& options, Sink sink);

}  // namespace rgs::lod
