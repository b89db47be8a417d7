// place_cells.cuh - ranks of tiles, and offsets of the Gaussians of their cells.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {

/// First rank of the tiles of class threadIdx.x % 32; longer lists precede it. All lanes of a warp call this and the
/// next functions.
__device__ inline std::uint32_t own_class_begin(const TurboArrays& a) {
  static_assert(kTurboClasses == 32, "a lane a class");
  const std::uint32_t size = a.state->class_size[threadIdx.x % 32];
  return inclusive_warp_sum(size) - size;
}
/// Rank of a tile with n_entries, from its index within its class.
__device__ inline std::uint32_t rank_of(std::uint32_t own_class_begin, std::uint32_t n_entries,
                                        std::uint32_t in_class) {
  return __shfl_sync(kFullWarp, own_class_begin, turbo_class(n_entries)) + in_class;
}

/// Number of tiles with lists; these have the first ranks.
__device__ inline std::uint32_t listed_tiles(const TurboArrays& a) {
  return a.n_tiles - a.state->class_size[kTurboClasses - 1];
}

__device__ inline void write_cell(const TurboArrays& a, math::TileGrid grid, std::uint32_t rank, std::uint32_t tile,
                                  std::uint32_t cell, std::uint32_t begin, std::uint32_t n) {
  const TurboCorner corner = cell_corner(grid, tile, cell);
  a.cells[kTurboCells * rank + cell] = {begin, n, corner.x, corner.y};
}

/// Where the Gaussians of a thread's cell start in TurboArrays::cell_gaussians, and whether the tile's fit.
struct CellPlace {
  std::uint32_t begin;
  bool fits;
};
/// Reserves places for the Gaussians of a tile's cells, cell_n [kTurboCells] in shared memory, and writes the cells for
/// the blending kernels; they are empty if there is no room. Threads 0 .. kTurboCells - 1 call it, one a cell.
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

/// Call from one thread once a tile's cells have their places; the last tile reports to the host.
__device__ inline void end_tile(const TurboArrays& a, TurboState* seen) {
  __threadfence();
  if (atomicAdd(&a.state->n_ordered, 1u) == a.n_tiles - 1) {
    __threadfence();
    seen->in_cells = *static_cast<volatile std::uint64_t*>(&a.state->in_cells);
    __threadfence_system();
  }
}

}  // namespace rgs::cuda
