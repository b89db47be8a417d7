// place_cells.cuh - the ranks of tiles, and where the Gaussians of a tile's cells go.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {

/// First rank of the tiles of class threadIdx.x % 32: those of longer lists come before them. All lanes of a warp call it, here
/// and below.
__device__ inline std::uint32_t own_class_begin(const TurboArrays& a) {
  static_assert(kTurboClasses == 32, "a lane a class");
  const std::uint32_t size = a.state->class_size[threadIdx.x % 32];
  return inclusive_warp_sum(size) - size;
}
/// The rank of a tile, whose list has n_entries, from its place in its class.
__device__ inline std::uint32_t rank_of(std::uint32_t own_class_begin, std::uint32_t n_entries,
                                        std::uint32_t in_class) {
  return __shfl_sync(kFullWarp, own_class_begin, turbo_class(n_entries)) + in_class;
}

/// Tiles that have lists: the first ranks.
__device__ inline std::uint32_t listed_tiles(const TurboArrays& a) {
  return a.n_tiles - a.state->class_size[kTurboClasses - 1];
}

__device__ inline void write_cell(const TurboArrays& a, math::TileGrid grid, std::uint32_t rank, std::uint32_t tile,
                                  std::uint32_t cell, std::uint32_t begin, std::uint32_t n) {
  const TurboCorner corner = cell_corner(grid, tile, cell);
  a.cells[kTurboCells * rank + cell] = {begin, n, corner.x, corner.y};
}

/// Where the Gaussians of a thread's cell begin in TurboArrays::cell_gaussians, and whether there is room for the tile's.
struct CellPlace {
  std::uint32_t begin;
  bool fits;
};
/// Finds places for the Gaussians of a tile's cells, cell_n [kTurboCells] in shared memory, and tells the blending kernels;
/// without room, that there are none. Threads 0 .. kTurboCells - 1 call it, one for each cell.
__device__ inline CellPlace place_cells(const TurboArrays& a, math::TileGrid grid, std::uint32_t rank,
                                        std::uint32_t tile, const std::uint32_t* cell_n) {
  const std::uint32_t own = threadIdx.x;
  std::uint32_t before = 0, total = 0;
  for (std::uint32_t c = 0; c < kTurboCells; ++c) {
    if (c < own) before += cell_n[c];
    total += cell_n[c];
  }
  std::uint64_t base = 0;
  if (own == 0 && total > 0) base = atomic_add(a.state->in_cells, total);
  base = __shfl_sync((1u << kTurboCells) - 1, base, 0);
  const CellPlace place{static_cast<std::uint32_t>(base) + before, base + total <= a.cell_capacity};
  write_cell(a, grid, rank, tile, own, place.begin, place.fits ? cell_n[own] : 0);
  return place;
}

/// A tile's cells have their places. One thread calls it; the last tile tells the host.
__device__ inline void end_tile(const TurboArrays& a, TurboState* seen) {
  __threadfence();
  if (atomicAdd(&a.state->n_ordered, 1u) == a.n_tiles - 1) {
    __threadfence();
    seen->in_cells = *static_cast<volatile std::uint64_t*>(&a.state->in_cells);
    __threadfence_system();
  }
}

}  // namespace rgs::cuda
