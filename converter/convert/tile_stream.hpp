// tile_stream.hpp - several scenes, each at its place, as one stream of Gaussians.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "stream_levels.hpp"

namespace rgs {

/// One scene: a PLY file, which is read block by block, or what `load` gives, which is in memory while it is its turn.
struct Tile {
  std::optional<PlyFile> ply;
  const MappedFile* file = nullptr;         ///< of the PLY, so that what was read may leave memory; or none
  std::function<Result<SplatFile>()> load;  ///< its axes are those of `axes`
  Axes axes = kAxes3dgs;
  Similarity placed;  ///< in the axes of the whole
};

/// What merging needs to know of each scene before it reads any.
struct TileFacts {
  std::uint64_t n = 0;
  int sh_degree = 0;
  bool gets_origin = false;  ///< its means become relative to `origin`, in the axes of the whole
  Origin origin = kNoOrigin;
};
/// Reads PLY files only where a translation may move them far. Errors: the tile's.
Result<TileFacts> look_at_tile(const Tile& tile, const Axes& axes);

/// Gaussians are those that merging all tiles in memory gives, in the same order and with the same bits.
class TileStream {
 public:
  /// Reads all tiles once. Errors: load's, with `failed` being that tile; limit_exceeded (more than 2^32 - 1 Gaussians).
  static Result<TileStream> open(std::vector<Tile> tiles, const Axes& axes, std::size_t& failed);
  /// One tile of a whole that has this origin and degree.
  static TileStream of_one(Tile tile, const TileFacts& facts, const Axes& axes, const Origin& origin, int sh_degree);

  lod::SplatStream stream() const;  ///< a view: the TileStream must outlive it
  const Origin& origin() const { return origin_; }
  std::uint64_t size() const { return n_; }
  int sh_degree() const { return sh_degree_; }
  const std::vector<Tile>& tiles() const { return tiles_; }
  /// How far coordinates were rounded so far, world units.
  double position_rounding() const { return rounding_; }

 private:
  void place(std::size_t i, SplatCloud& block) const;

  std::vector<Tile> tiles_;
  std::vector<TileFacts> facts_;
  Axes axes_ = kAxes3dgs;
  Origin origin_ = kNoOrigin;
  std::uint64_t n_ = 0;
  int sh_degree_ = 0;
  mutable double rounding_ = 0;
};

}  // namespace rgs
