// tile_stream.hpp - several placed scenes as one stream of Gaussians.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "convert.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "stream_levels.hpp"

namespace rgs {

/// One scene: a PLY file, or what `read` hands over (ReadOptions::visit).
struct Tile {
  std::optional<PlyFile> ply;
  const MappedFile* file = nullptr;  ///< of the PLY, so that read pages can leave memory; or null
  std::function<Result<SplatFile>(const std::function<Status(SplatFile& piece)>& visit)> read;  ///< in `axes`
  Axes axes = kAxes3dgs;
  Similarity placed;  ///< in the axes of the whole
};

/// What merging needs to know of each scene in advance.
struct TileFacts {
  std::uint64_t n = 0;
  int sh_degree = 0;
  bool gets_origin = false;  ///< its means become relative to `origin`, in the axes of the whole
  Origin origin = kNoOrigin;
};
/// Reads a PLY file only if a translation may move it far. Errors: the tile's.
Result<TileFacts> tile_facts(const Tile& tile, const Axes& axes);

/// Streams the Gaussians that merging all tiles in memory would give, in the same order and with the same bits, but
/// where pieces of a tile have origins of their own, which spare a rounding.
class TileStream {
 public:
  /// Reads all tiles once. Errors: those of read for tile `failed`; limit_exceeded (more than 2^32 - 1 Gaussians).
  static Result<TileStream> open(std::vector<Tile> tiles, const Axes& axes, std::size_t& failed);
  /// One tile of a whole with this origin and degree.
  static TileStream of_one(Tile tile, const TileFacts& facts, const Axes& axes, const Origin& origin, int sh_degree);

  /// A view: the TileStream must outlive it. Gaussians have a Splat::mean_rest where FP32 rounds. Errors of reading:
  /// those of read.
  lod::SplatStream stream() const;
  /// The tile whose reading goes on or failed; else 0.
  std::size_t reading() const { return reading_; }
  const Origin& origin() const { return origin_; }
  std::uint64_t size() const { return n_; }
  int sh_degree() const { return sh_degree_; }
  const std::vector<Tile>& tiles() const { return tiles_; }
  /// Of all so far.
  const MeanRounding& rounding() const { return rounding_; }

 private:
  void place(std::size_t i, SplatFile& piece) const;

  std::vector<Tile> tiles_;
  std::vector<TileFacts> facts_;
  Axes axes_ = kAxes3dgs;
  Origin origin_ = kNoOrigin;
  std::uint64_t n_ = 0;
  int sh_degree_ = 0;
  mutable MeanRounding rounding_;
  mutable std::size_t reading_ = 0;
};

}  // namespace rgs
