// audit_source.hpp - the Gaussians from which an asset was made, in a file of any format.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>

#include "rgs/decode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/result.hpp"

namespace rgs::audit {

/// Reads a PLY row by row from its file; holds other files in memory, of levels of detail level 0. Copies share it.
/// Reading is thread-safe.
class Source {
 public:
  Source() = default;
  Source(const PlyFile& ply) : ply_(&ply) {}  // NOLINT: a PLY file is a source; it must outlive this one
  /// The file's Gaussians in `axes`, or unchanged if either is undeclared. Without `axes`: a PLY in its own, others in
  /// those of 3DGS. Of `options` limits and SPZ's axes count. Errors: those of MappedFile::open(), PlyFile::open() and read_splats().
  static Result<Source> open(const std::string& path, ReadOptions options, const std::optional<Axes>& axes);

  std::uint64_t size() const { return ply_ != nullptr ? ply_->size() : file_->cloud.size(); }
  int sh_degree() const { return ply_ != nullptr ? ply_->sh_degree() : file_->cloud.sh_degree; }
  std::uint64_t bytes() const { return ply_ != nullptr ? ply_->bytes() : file_->bytes; }
  SplatFormat format() const { return ply_ != nullptr ? SplatFormat::ply : file_->format; }
  /// The file's declarations; axes and origin are those of the Gaussians.
  const Declarations& declarations() const { return ply_ != nullptr ? ply_->declarations() : stated_; }
  /// Largest rounding of a coordinate in what was read so far, world units.
  double position_rounding() const { return ply_ != nullptr ? ply_->position_rounding() : file_->position_rounding; }
  const Origin& origin() const { return ply_ != nullptr ? ply_->origin() : file_->origin; }
  /// Of an .rgs whose axes were kept: the file and its limits, for drawing its values as stored. Its Gaussians here went
  /// through logarithms, which round.
  const std::string& stored_path() const { return stored_path_; }
  const DecodeLimits& limits() const { return limits_; }
  /// Of an .rgs: its source, which an asset made from it names as its own.
  std::optional<Provenance> provenance() const { return ply_ != nullptr ? std::nullopt : file_->provenance; }
  /// Of an .rgs that keeps them: the Gaussians' positions in its source; else empty.
  std::span<const std::uint32_t> source_index() const {
    return ply_ != nullptr ? std::span<const std::uint32_t>() : file_->source_index;
  }
  /// The same Gaussians with means relative to `origin`. Errors: those of PlyFile::open().
  Result<Source> relative_to(const Origin& origin) const;

  void read(std::uint64_t first, std::span<Splat> out) const;
  /// Gaussians indices[0], indices[1], ...; out.size() == indices.size().
  void gather(std::span<const std::uint32_t> indices, std::span<Splat> out) const;

 private:
  const PlyFile* ply_ = nullptr;
  std::shared_ptr<const PlyFile> owned_;
  std::shared_ptr<const SplatFile> file_;
  Declarations stated_;
  std::string stored_path_;
  DecodeLimits limits_;
};

}  // namespace rgs::audit
