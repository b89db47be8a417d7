// stream_levels.hpp - a scene of any size to a file with levels, in bounded memory.
// SPDX-License-Identifier: Apache-2.0
//
// The steps, each over ranges that know nothing of each other, so that other processes may run them one day:
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
Status build_upper(const EncodeOptions& encode, const StreamOptions& options, StreamedLevels& out);
/// Errors: LevelsWriter's too.
Result<WrittenScene> write_tree(const StreamedLevels& levels, const SceneScan& scan, const EncodeOptions& encode,
                                const StreamOptions& options, Sink sink);

}  // namespace rgs::lod
