// scene_input.hpp - the bytes of one input of a conversion, and their hash.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"
#include "rgs/result.hpp"
#include "rgs/spool_file.hpp"
#include "tile_stream.hpp"

namespace rgs {

/// A mapped file, or standard input ("-") spooled. Results must not outlive it.
class SceneInput {
 public:
  /// Errors: MappedFile::open()'s, SpoolFile's.
  Status open(const std::string& path);
  const std::string& path() const { return path_; }
  std::span<const std::byte> bytes() const { return bytes_; }
  const MappedFile& file() const { return file_; }
  /// The file name without folders, for provenance.
  std::string name() const;
  /// Of a PLY: WKT of the .prj beside it, in one line; else empty.
  const std::string& prj() const { return prj_; }
  /// XXH3-64 of the bytes; drops their pages from memory as it reads.
  std::uint64_t hash() const;
  /// The whole scene, in the axes of the file.
  Result<SplatFile> read(ReadOptions options) const;
  /// The levels that the file has of its own: open_levels(); none of standard input but of a zip archive or .rad.
  Result<LevelTree> levels(const ReadOptions& options) const;
  /// For an .rgs with levels: how many Gaussians of each page `passing` keeps; of pages missing at the end, all. Empty
  /// for other files. `passing` gets some pages at a time, in the axes of the file and with only its origin, and
  /// returns the positions that it keeps, ascending. Errors: PagedFile's, read_pages()'s.
  using Passing = std::function<std::vector<std::uint64_t>(SplatFile some)>;
  Result<std::vector<std::uint32_t>> count_in_pages(const DecodeLimits& limits, const Passing& passing) const;
  /// A PLY file read in place, or the result of read(); the caller sets `axes` and `placed`. Errors: PlyFile::open()'s.
  Result<Tile> tile(SplatFormat format, const ReadOptions& options) const;

 private:
  std::string path_, prj_;
  MappedFile file_;
  detail::SpoolFile spool_;
  std::span<const std::byte> bytes_;
};

/// The hash of provenance for sources with these hashes: a single one itself, else the hash of the hashes (u64 each),
/// so that sources can be hashed in parallel.
std::uint64_t hash_of_sources(std::span<const std::uint64_t> hashes);

}  // namespace rgs
