// scene_input.hpp - the bytes of one input of a conversion, and their hash.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

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
