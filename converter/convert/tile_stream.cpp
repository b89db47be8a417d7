// tile_stream.cpp - streams tiles block by block, transformed as by merging in memory.
// SPDX-License-Identifier: Apache-2.0
#include "tile_stream.hpp"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <limits>
#include <utility>

#include "convert.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kRows = 65536;

// Of a PLY a piece has Gaussians and origin alone.
Status read_tile(const Tile& tile, const std::function<Status(SplatFile& piece)>& visit) {
  if (!tile.ply) return tile.read(visit).map([](const SplatFile&) {});
  SplatFile piece;
  piece.origin = tile.ply->origin();
  SplatCloud& block = piece.cloud;
  const bool has_rests = tile.ply->has_rests();
  std::vector<Splat> rows;
  for (std::uint64_t first = 0; first < tile.ply->size(); first += kRows) {
    rows.resize(std::min(kRows, tile.ply->size() - first));
    tile.ply->read(first, rows);
    block.resize(rows.size(), tile.ply->sh_degree());
    if (has_rests) block.mean_rest.resize(3 * rows.size());
    for (std::size_t k = 0; k < rows.size(); ++k) block.set(k, rows[k]);
    const std::uint64_t begin = tile.ply->row_offset(first), end = tile.ply->row_offset(first + rows.size() - 1);
    if (tile.file != nullptr && end != Error::kNone) tile.file->advise(MappedFile::Access::done, begin, end - begin);
    if (Status s = visit(piece); !s) return s;
  }
  return {};
}

// Where an origin of the tile's file lies in the whole, if there are origins.
Origin placed_origin(const Tile& tile, Origin origin, const Axes& axes) {
  convert_axes(origin, tile.axes, axes);
  const Similarity& far = tile.placed;
  const glm::dvec3 at = far.rotation * glm::dvec3(origin[0], origin[1], origin[2]) * far.scale + far.translation;
  return {at.x + 0.0, at.y + 0.0, at.z + 0.0};
}

}  // namespace

Result<TileFacts> tile_facts(const Tile& tile, const Axes& axes) {
  TileFacts facts;
  FarMove move(tile.placed);
  if (tile.ply) {
    facts = {tile.ply->size(), tile.ply->sh_degree(), false, tile.ply->origin()};
    if (tile.placed.translation != glm::dvec3(0) && facts.origin == kNoOrigin) {
      const auto add = [&move](const SplatFile& piece) {
        move.add(piece.cloud.mean);
        return Status();
      };
      if (Status s = read_tile(tile, add); !s) return tl::unexpected(s.error());
    }
  } else {
    bool has_origins = false;  // of pieces
    const auto file = tile.read([&](SplatFile& piece) -> Status {
      has_origins = has_origins || piece.origin != kNoOrigin;
      facts.n += piece.cloud.size();
      facts.sh_degree = std::max(facts.sh_degree, piece.cloud.sh_degree);
      move.add(piece.cloud.mean);
      return {};
    });
    if (!file) return tl::unexpected(file.error());
    facts.sh_degree = std::max(facts.sh_degree, file->cloud.sh_degree);
    facts.origin = file->origin;
    facts.gets_origin = has_origins;
  }
  // As transform_splats() of a scene with an origin.
  facts.gets_origin = facts.gets_origin || facts.origin != kNoOrigin || move.is_far();
  if (facts.gets_origin) facts.origin = placed_origin(tile, facts.origin, axes);
  return facts;
}

void TileStream::place(std::size_t i, SplatFile& piece) const {
  SplatCloud& cloud = piece.cloud;
  Similarity moved = tiles_[i].placed;
  convert_axes(cloud, tiles_[i].axes, axes_);
  Origin from = kNoOrigin;
  if (facts_[i].gets_origin) {
    moved.translation = {0, 0, 0};
    from = placed_origin(tiles_[i], piece.origin, axes_);
  }
  if (from != origin_ || moved.translation != glm::dvec3(0)) cloud.mean_rest.resize(cloud.mean.size());
  transform_splats(cloud, moved);
  if (from != origin_) rebase_exactly(cloud.mean, cloud.mean_rest, from, origin_);
  rounding_.add({piece.position_rounding * moved.scale, largest_rest(cloud.mean_rest)});
}

Result<TileStream> TileStream::open(std::vector<Tile> tiles, const Axes& axes, std::size_t& failed) {
  TileStream out;
  out.tiles_ = std::move(tiles);
  out.axes_ = axes;
  std::vector<Origin> origins;
  for (std::size_t i = 0; i < out.tiles_.size(); ++i) {
    failed = i;
    const auto facts = tile_facts(out.tiles_[i], axes);
    if (!facts) return tl::unexpected(facts.error());
    out.facts_.push_back(*facts);
    out.n_ += facts->n;
    out.sh_degree_ = std::max(out.sh_degree_, facts->sh_degree);
    if (facts->n != 0) origins.push_back(facts->origin);
  }
  out.origin_ = merged_origin(origins);
  if (out.n_ > std::numeric_limits<std::uint32_t>::max()) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                      std::numeric_limits<std::uint32_t>::max(), out.n_);
  }
  return out;
}

TileStream TileStream::of_one(Tile tile, const TileFacts& facts, const Axes& axes, const Origin& origin,
                              int sh_degree) {
  TileStream out;
  out.tiles_.push_back(std::move(tile));
  out.facts_ = {facts};
  out.axes_ = axes;
  out.origin_ = origin;
  out.n_ = facts.n;
  out.sh_degree_ = sh_degree;
  return out;
}

lod::SplatStream TileStream::stream() const {
  return {n_, sh_degree_, [this](const lod::SplatStream::Visit& visit) -> Status {
            std::uint64_t first = 0;
            std::vector<Splat> rows;
            for (reading_ = 0; reading_ < tiles_.size(); ++reading_) {
              const Status read = read_tile(tiles_[reading_], [&](SplatFile& piece) -> Status {
                place(reading_, piece);
                const SplatView view = piece.cloud.view();
                for (std::uint64_t at = 0; at < view.n; at += kRows) {
                  rows.resize(std::min(kRows, view.n - at));
                  tbb::parallel_for(std::size_t{0}, rows.size(), [&](std::size_t k) { rows[k] = view.splat(at + k); });
                  if (Status s = visit(first, rows); !s) return s;
                  first += rows.size();
                }
                return {};
              });
              if (!read) return read;
            }
            reading_ = 0;
            return {};
          }};
}

}  // namespace rgs
