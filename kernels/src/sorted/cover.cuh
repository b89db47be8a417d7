// cover.cuh - the tiles of a Gaussian, row by row, in a form that fits shared memory.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/projection.hpp"

namespace rgs::cuda {

/// Tile rows first_row .. first_row + n_rows - 1 may list the Gaussian.
template <math::Extent E>
struct Cover;

template <>
struct Cover<math::Extent::square> {
  math::TileRect rect;

  __device__ static Cover of(const math::Projected<float>& p, float, math::TileGrid grid, math::TileSpan columns) {
    auto rect = math::square_extent(p.mean, p.footprint.cov, grid);
    rect.x0 = math::max(rect.x0, columns.first), rect.x1 = math::min(rect.x1, columns.last);
    return {rect};
  }
  __device__ int first_row() const { return rect.y0; }
  __device__ std::uint32_t n_rows() const { return rect.empty() ? 0 : static_cast<std::uint32_t>(rect.y1 - rect.y0); }
  __device__ math::TileSpan tiles(int, math::TileGrid) const { return {rect.x0, rect.x1}; }
};

template <>
struct Cover<math::Extent::ellipse> {
  math::Ellipse<float> ellipse;
  std::uint16_t x0, x1;  // the columns that the splat may show in
  std::uint16_t y0, y1;

  __device__ static Cover of(const math::Projected<float>& p, float cutoff, math::TileGrid grid,
                             math::TileSpan columns) {
    const auto e = math::ellipse(p.mean, p.footprint, cutoff);
    const auto rect = math::bounding_tiles(e, grid);
    const auto tile = [](int at) { return static_cast<std::uint16_t>(at); };
    return {e, tile(columns.first), tile(columns.last), tile(rect.y0), tile(rect.empty() ? rect.y0 : rect.y1)};
  }
  __device__ int first_row() const { return y0; }
  __device__ std::uint32_t n_rows() const { return static_cast<std::uint32_t>(y1 - y0); }
  __device__ math::TileSpan tiles(int row, math::TileGrid grid) const {
    const auto span = math::tiles_in_row(ellipse, row, grid);
    const int first = math::max(span.first, int{x0});
    return {first, math::max(first, math::min(span.last, int{x1}))};
  }
};

/// The depth part of the key.
__device__ inline std::uint32_t depth_key(const ViewParameters& v, float z) {
  return v.key.quantized ? math::quantize_depth(v.quantizer, z) : math::depth_bits(z);
}

template <class Key>
__device__ inline Key make_key(const ViewParameters& v, std::uint32_t tile, std::uint32_t depth) {
  return static_cast<Key>(static_cast<std::uint64_t>(tile) << v.key.depth_bits | depth);
}

}  // namespace rgs::cuda
