// tile_stream.cpp - tiles block by block, moved as merging in memory would move them.
// SPDX-License-Identifier: Apache-2.0
#include "tile_stream.hpp"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <limits>
#include <utility>

namespace rgs {
namespace {

constexpr std::uint64_t kRows = 65536;

}  // namespace

Status TileStream::read_tile(std::size_t i, const Visit& visit) const {
  const Tile& tile = tiles_[i];
  if (!tile.ply) {
    auto loaded = tile.load();
    if (!loaded) return tl::unexpected(loaded.error());
    return visit(loaded->cloud);
  }
  SplatCloud block;
  std::vector<Splat> rows;
  for (std::uint64_t first = 0; first < tile.ply->size(); first += kRows) {
    rows.resize(std::min(kRows, tile.ply->size() - first));
    tile.ply->read(first, rows);
    block.resize(rows.size(), tile.ply->sh_degree());
    for (std::size_t k = 0; k < rows.size(); ++k) block.set(k, rows[k]);
    const std::uint64_t begin = tile.ply->row_offset(first), end = tile.ply->row_offset(first + rows.size() - 1);
    if (tile.file != nullptr && end != Error::kNone) tile.file->advise(MappedFile::Access::done, begin, end - begin);
    if (Status s = visit(block); !s) return s;
  }
  return {};
}

void TileStream::place(std::size_t i, SplatCloud& block) const {
  const Placed& placed = placed_[i];
  Similarity moved = tiles_[i].placed;
  convert_axes(block, tiles_[i].axes, axes_);
  if (placed.gets_origin) moved.translation = {0, 0, 0};
  transform_splats(block, moved);
  rounding_ = std::max(rounding_, rebase_splats(block, placed.origin, origin_));
}

Result<TileStream> TileStream::open(std::vector<Tile> tiles, const Axes& axes, std::size_t& failed) {
  TileStream out;
  out.tiles_ = std::move(tiles);
  out.axes_ = axes;
  for (std::size_t i = 0; i < out.tiles_.size(); ++i) {
    failed = i;
    const Tile& tile = out.tiles_[i];
    Placed& placed = out.placed_.emplace_back();
    FarMove move(tile.placed);
    const bool moves = tile.placed.translation != glm::dvec3(0);
    if (tile.ply) {
      placed.origin = tile.ply->origin();
      out.n_ += tile.ply->size();
      out.sh_degree_ = std::max(out.sh_degree_, tile.ply->sh_degree());
      if (moves && placed.origin == kNoOrigin) {
        const auto add = [&move](SplatCloud& block) {
          move.add(block.mean);
          return Status();
        };
        if (Status s = out.read_tile(i, add); !s) return tl::unexpected(s.error());
      }
    } else {
      const auto loaded = tile.load();
      if (!loaded) return tl::unexpected(loaded.error());
      placed.origin = loaded->origin;
      out.n_ += loaded->cloud.size();
      out.sh_degree_ = std::max(out.sh_degree_, loaded->cloud.sh_degree);
      move.add(loaded->cloud.mean);
    }
    // As transform_splats() of a scene with an origin, and append_splats().
    convert_axes(placed.origin, tile.axes, axes);
    placed.gets_origin = placed.origin != kNoOrigin || move.is_far();
    if (placed.gets_origin) {
      const Similarity& far = tile.placed;
      const glm::dvec3 at =
          far.rotation * glm::dvec3(placed.origin[0], placed.origin[1], placed.origin[2]) * far.scale + far.translation;
      placed.origin = {at.x + 0.0, at.y + 0.0, at.z + 0.0};
    }
    if (out.origin_ == kNoOrigin) out.origin_ = placed.origin;
  }
  if (out.n_ > std::numeric_limits<std::uint32_t>::max()) {
    return make_error(Errc::limit_exceeded, Error::kNone, "more than 2^32 - 1 Gaussians; split the scene",
                      std::numeric_limits<std::uint32_t>::max(), out.n_);
  }
  return out;
}

lod::SplatStream TileStream::stream() const {
  return {n_, sh_degree_, [this](const lod::SplatStream::Visit& visit) -> Status {
            std::uint64_t first = 0;
            std::vector<Splat> rows;
            for (std::size_t i = 0; i < tiles_.size(); ++i) {
              const Status read = read_tile(i, [&](SplatCloud& block) -> Status {
                place(i, block);
                const SplatView view = block.view();
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
            return {};
          }};
}

}  // namespace rgs
