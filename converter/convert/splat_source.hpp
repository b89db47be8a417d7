// splat_source.hpp - the source of convert_to_rgs(): the rows of a PLY file, or a cloud in memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cassert>
#include <cstdint>
#include <span>

#include "rgs/checksum.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_cloud.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs {

/// A view: the PLY or cloud must outlive it. Reading is thread-safe.
class SplatSource {
 public:
  SplatSource(const PlyFile& ply) : ply_(&ply) {}  // NOLINT: a PLY file is a source
  /// `bytes` and `source_xxh3` describe the cloud's file or files, `origin` is that of its means.
  SplatSource(const SplatView& cloud, std::uint64_t bytes, std::uint64_t source_xxh3, const Origin& origin = kNoOrigin)
      : cloud_(cloud), bytes_(bytes), xxh3_(source_xxh3), origin_(origin) {}

  std::uint64_t size() const { return ply_ != nullptr ? ply_->size() : cloud_.n; }
  int sh_degree() const { return ply_ != nullptr ? ply_->sh_degree() : cloud_.sh_degree; }
  /// The origin of the means.
  const Origin& origin() const { return ply_ != nullptr ? ply_->origin() : origin_; }
  /// Largest rounding of a coordinate in what was read so far, world units; of a cloud the largest rest.
  double position_rounding() const {
    return ply_ != nullptr ? ply_->position_rounding() : largest_rest(cloud_.mean_rest);
  }
  std::uint64_t bytes() const { return ply_ != nullptr ? ply_->bytes() : bytes_; }
  /// XXH3-64 of the source's bytes; reads a PLY file to its end.
  std::uint64_t hash() const { return ply_ != nullptr ? xxh3(ply_->source()) : xxh3_; }
  /// The bytes of a PLY file; empty for a cloud.
  std::span<const std::byte> source() const { return ply_ != nullptr ? ply_->source() : std::span<const std::byte>(); }
  /// Byte at which Gaussian i starts in the source; Error::kNone if unknown.
  std::uint64_t row_offset(std::uint64_t i) const { return ply_ != nullptr ? ply_->row_offset(i) : Error::kNone; }

  /// Gaussians first .. first + out.size() - 1.
  void read(std::uint64_t first, std::span<Splat> out) const {
    if (ply_ != nullptr) return ply_->read(first, out);
    for (std::size_t i = 0; i < out.size(); ++i) out[i] = cloud_.splat(first + i);
  }
  /// Gaussians indices[0], indices[1], ...; out.size() == indices.size().
  void gather(std::span<const std::uint32_t> indices, std::span<Splat> out) const {
    assert(indices.size() == out.size());
    if (ply_ != nullptr) return ply_->gather(indices, out);
    std::ranges::transform(indices, out.begin(), [this](std::uint32_t i) { return cloud_.splat(i); });
  }

 private:
  const PlyFile* ply_ = nullptr;
  SplatView cloud_;
  std::uint64_t bytes_ = 0, xxh3_ = 0;
  Origin origin_ = kNoOrigin;
};

}  // namespace rgs
