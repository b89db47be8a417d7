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
#include "rgs/result.hpp"
#include "rgs/spool_file.hpp"
#include "tile_stream.hpp"

namespace rgs {

/// A mapped file, or standard input ("-") spooled. What is made of it must not outlive it.
class SceneInput {
 public:
  /// Errors: MappedFile::open()'s, SpoolFile's.
  Status open(const std::string& path);
  const std::string& path() const { return path_; }
  std::span<const std::byte> bytes() const { return bytes_; }
  const MappedFile& file() const { return file_; }
  /// Without folders, as provenance keeps it.
  std::string name() const;
  /// XXH3-64 of the bytes, which leave memory meanwhile.
  std::uint64_t hash() const;
  /// The whole scene, in the axes of the file.
  Result<SplatFile> read(ReadOptions options) const;
  /// Of an .rgs with levels: how many Gaussians of each page `passing` lets pass; all of those that are missing at the end.
  /// Of other files nothing. `passing` gets some pages at a time, in the axes of the file and with its origin alone, and
  /// gives the positions that pass in ascending order. Errors: PagedFile's, read_pages()'s.
  using Passing = std::function<std::vector<std::uint64_t>(SplatFile some)>;
  Result<std::vector<std::uint32_t>> count_in_pages(const DecodeLimits& limits, const Passing& passing) const;
  /// A PLY file in place, or what read() gives; `axes` and `placed` are the caller's to set. Errors: PlyFile::open()'s.
  Result<Tile> tile(SplatFormat format, const ReadOptions& options) const;

 private:
  std::string path_;
  MappedFile file_;
  detail::SpoolFile spool_;
  std::span<const std::byte> bytes_;
};

/// The hash that provenance has of sources with these hashes: of one its own, of several that of their hashes (u64 each), so
/// that nobody has to read them one after the other.
std::uint64_t hash_of_sources(std::span<const std::uint64_t> hashes);

}  // namespace rgs
