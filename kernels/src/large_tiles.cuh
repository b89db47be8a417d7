// large_tiles.cuh - the tiles of Gaussians that touch many, a thread a row of tiles.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {

/// Entries of each tile, behind the state: see TurboState::bytes().
struct TileCounts {
  unsigned long long* block;  ///< [tiles] entries of blocks, and their runs << 32
  std::uint32_t* large;       ///< [tiles]

  __device__ static TileCounts of(const TurboArrays& a) {
    auto* const block = reinterpret_cast<unsigned long long*>(a.state + 1);
    return {block, reinterpret_cast<std::uint32_t*>(block + a.n_tiles)};
  }
};

__device__ inline TurboEntry make_entry(std::uint32_t depth, std::uint32_t index, std::uint32_t cells) {
  return static_cast<std::uint64_t>(depth) << (kTurboIndexBits + 8) | static_cast<std::uint64_t>(index) << 8 | cells;
}

/// Calls f(first tile, cells [4]) for the tiles that row `row` of the part touches, four neighbours at a time; cells are
/// 0 where a tile is not touched. To give the same cells in every kernel that calls it, it must be compiled without
/// contraction to FMA.
template <class F>
__device__ void for_each_large_tiles(const TurboLarge& part, std::uint32_t row, math::TileGrid grid, const F& f) {
  const int y = part.row + static_cast<int>(row);
  const auto rows = math::cell_rows(part.ellipse, y, grid);
  const auto span = math::tiles_of(rows, {part.column, part.column + part.n_columns});
  for (int column = span.first; column < span.last; column += 4) {
    const std::uint32_t four = math::cells_of_four(rows, column);
    std::uint32_t cells[4];
#pragma unroll
    for (int k = 0; k < 4; ++k) cells[k] = column + k < span.last ? math::cells_of_first(four >> (2 * k)) : 0;
    f(static_cast<std::uint32_t>(y * grid.columns + column), cells);
  }
}

/// Calls f(part's place, row of it, whether there is one) with the parts' rows side by side, eight threads a part. All
/// threads of a warp call f together, whose blocks are `block` of `n_blocks`.
template <int Threads, class F>
__device__ void for_each_large_row(const TurboArrays& a, std::uint32_t block, std::uint32_t n_blocks, const F& f) {
  constexpr std::uint32_t kParts = Threads / kTurboLargeRows;
  const auto n = static_cast<std::uint32_t>(math::min(std::uint64_t{a.state->n_large}, a.large_capacity));
  const std::uint32_t own = threadIdx.x / kTurboLargeRows, row = threadIdx.x % kTurboLargeRows;
  for (std::uint32_t first = block * kParts; first < n; first += n_blocks * kParts) f(first + own, row, first + own < n);
}

}  // namespace rgs::cuda
