// turbo_emit.cu - turns attributes into entries of the tiles' lists, in runs of one tile each.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp; turbo_geometry.hpp
// In/Out  attributes [n] -> splats [n], entries, runs, large
// Cost    as front_end.cu, with 8 B written an entry, and 16 B and an atomic addition a run
// Launch  256 threads, ceil(n / 256) blocks; with levels n is a capacity. Blocks beyond the drawn rows end at once; where
//         chunks are whole blocks, those outside the view too
// Shared  Shared: ellipses and boxes, the sums that map tile rows to their Gaussians, a counter for each tile of a window,
//         candidates between counting and placing; 33 KiB
// Order   entries and runs: any. Lists are ordered later, by depth and index, so the image is the same on every run.
//         Compiled without contraction to FMA, see project.cu.
//
// Neighbours in a file are neighbours in space: a block's 256 Gaussians touch few tiles, many of them together. So the
// block sorts its entries by tile, by counting, before it writes them. Meanwhile it keeps what their rows show as
// candidates, one for each tile of a Gaussian's bounding box. The tiles of the block's own bounding box are counted
// 1,024 at a time; most blocks have fewer. A Gaussian of many tiles, which would delay its block, is left to
// turbo_large_gaussians.cu, as is one whose candidates do not fit.
#include <cstdint>
#include <type_traits>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/cull_chunk.cuh"
#include "common/drawn_rows.cuh"
#include "common/launch.cuh"
#include "common/load_splat.cuh"
#include "common/project_splat.cuh"
#include "turbo/emit_runs.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kWindow = 4 * kThreads;  // tiles counted at a time
constexpr std::uint32_t kLargeTiles = 64;        // most tiles of a bounding box in a block
constexpr std::uint32_t kCandidates = 4096;      // capacity of a block

// A candidate entry: a tile of a Gaussian's bounding box, numbered within the block's box; the owner among the block's
// Gaussians; and the touched cells of the tile, none if it has no entry.
constexpr int kOwnerBits = 8, kOwnerAt = kTurboCellBits, kTileAt = kOwnerAt + kOwnerBits;
constexpr std::uint32_t kBlockTiles = 1u << (32 - kTileAt);  // that a candidate can address
static_assert(kThreads <= 1 << kOwnerBits);
__device__ inline std::uint32_t make_candidate(std::uint32_t tile, std::uint32_t owner, std::uint32_t cells) {
  return tile << kTileAt | owner << kOwnerAt | cells;
}
__device__ inline std::uint32_t tile_in(std::uint32_t candidate) {
  return candidate >> kTileAt;
}
__device__ inline std::uint32_t owner_in(std::uint32_t candidate) {
  return candidate >> kOwnerAt & ((1u << kOwnerBits) - 1);
}
__device__ inline std::uint32_t cells_in(std::uint32_t candidate) {
  return candidate & ((1u << kTurboCellBits) - 1);
}

struct Box {
  std::uint16_t x, y;
  std::uint16_t first;  // its first candidate
  std::uint8_t columns, rows;
};
static_assert(kLargeTiles < 256 && kThreads * kLargeTiles < 1 << 15);

struct Shared {
  math::Ellipse<float> ellipse[kThreads];
  Box box[kThreads];
  std::uint32_t depth[kThreads];              // turbo_depth()
  std::uint16_t row_end[kThreads];            // inclusive sums of the Gaussians' rows after the first
  std::uint8_t listed[kThreads];              // the Gaussian has an entry
  alignas(16) std::uint32_t counts[kWindow];  // entries of each tile of the window; then the place of the next one
  std::uint32_t candidates[kCandidates];
  std::uint32_t n_candidates;
  std::uint32_t bounds[4];  // of the block: largest 2^15 - x0, 2^15 - y0, x1, y1
  RunPlaces<kThreads> places;
};
constexpr std::uint32_t kOrigin = 1u << 15;

// Fills in the candidates and calls f(tile) for every entry among them: first the first rows of the 256 Gaussians, a
// thread each, then all other rows side by side.
template <class F>
__device__ void fill_candidates(Shared& s, std::uint32_t n_rows, const math::TileRect& block, const F& f) {
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    std::uint32_t owner = r, row = 0;
    if (r >= kThreads) {
      owner = owner_of<kThreads>(s.row_end, r - kThreads);
      row = r - kThreads - (owner == 0 ? 0 : s.row_end[owner - 1]) + 1;
    }
    const Box box = s.box[owner];
    if (row >= box.rows) continue;
    const int y = box.y + static_cast<int>(row);
    const auto cells = cell_rows(s.ellipse[owner], y);
    std::uint32_t* const own = s.candidates + box.first + row * box.columns;
    const auto first = static_cast<std::uint32_t>((y - block.y0) * (block.x1 - block.x0) + box.x - block.x0);
    for (std::uint32_t k = 0; k < box.columns; k += kTurboStripTiles) {
      const std::uint32_t strip = cells_of_strip(cells, box.x + static_cast<int>(k));
#pragma unroll
      for (std::uint32_t j = 0; j < kTurboStripTiles; ++j) {
        if (k + j >= box.columns) break;
        const std::uint32_t touched = cells_in_strip(strip, static_cast<int>(j)), tile = first + k + j;
        own[k + j] = make_candidate(tile, owner, touched);
        if (touched != 0) f(tile);
      }
    }
  }
}

// Reserves the window's entries and runs; counts become the places of the tiles' first entries.
__device__ void place_window(Shared& s, std::uint32_t window, const math::TileRect& block, const TurboArrays& out,
                             math::TileGrid grid) {
  const auto width = static_cast<std::uint32_t>(block.x1 - block.x0);
  const std::uint32_t n_tiles = width * static_cast<std::uint32_t>(block.y1 - block.y0);
  for (std::uint32_t first = 0; first < kWindow && window + first < n_tiles; first += kThreads) {
    std::uint32_t& count = s.counts[first + threadIdx.x];
    const std::uint32_t n = count, in_block = window + first + threadIdx.x;
    std::uint32_t tile = 0;
    if (n > 0) {
      const std::uint32_t row = in_block / width;
      tile = (static_cast<std::uint32_t>(block.y0) + row) * static_cast<std::uint32_t>(grid.columns) +
             static_cast<std::uint32_t>(block.x0) + in_block - row * width;
    }
    count = reserve_runs(s.places, n, tile, out);
    __syncthreads();
  }
}

// Leaves a Gaussian to turbo_large_gaussians.cu.
__device__ void set_aside(const TurboArrays& out, const math::Ellipse<float>& ellipse, const math::TileRect& rect,
                          std::uint32_t depth, std::uint32_t i) {
  const std::uint32_t at = atomicAdd(&out.state->n_large_gaussians, 1u);
  if (at >= out.large_capacity) return;
  out.large_gaussians[at] = {ellipse, depth, i, 0, {}};
  out.large_boxes[at] = {static_cast<std::uint16_t>(rect.x0), static_cast<std::uint16_t>(rect.y0),
                         static_cast<std::uint16_t>(rect.x1), static_cast<std::uint16_t>(rect.y1)};
}

template <bool kAnyModel, class A>
__global__ void __launch_bounds__(kThreads, resident_on_90(kAnyModel ? 0 : 5))
    turbo_emit_kernel(A attributes, const __grid_constant__ CullPlanes planes, TurboEmitArguments a) {
  __shared__ Shared memory;
  Shared& s = memory;
  const ViewParameters& v = a.view;
  const std::uint32_t first = blockIdx.x * kThreads;
  const std::uint32_t i = first + threadIdx.x;
  const std::uint32_t copies = kAnyModel ? math::n_copies(v.view) : 1;
  // With levels, i counts copies of drawn rows.
  std::uint32_t n = a.n;
  if constexpr (std::is_same_v<A, PagedAttributes>) {
    n = n_drawn_rows(a.drawn, attributes.chunk_size) * copies;
    if (first >= n) return;
  }
  const std::uint32_t in_frame = math::min(i, n - 1) / copies, row = row_of(attributes, a.drawn, in_frame);
  if (i == 0) a.arrays.state->dropped = turbo_dropped_bits(n);
  const bool is_chunk_in_view = chunk_in_view(attributes, in_frame, v.view, planes);
  if constexpr (std::is_same_v<A, CompactAttributes>) {
    if (!is_chunk_in_view && attributes.chunk_size % kThreads == 0) return;  // the whole block
  }
  const auto clear_counts = [&s] {
    static_assert(kWindow == 4 * kThreads);
    reinterpret_cast<uint4*>(s.counts)[threadIdx.x] = {};
  };
  clear_counts();
  s.listed[threadIdx.x] = 0;
  if (threadIdx.x < 4) s.bounds[threadIdx.x] = 0;

  math::TileRect rect{};
  std::uint32_t n_columns = 0, n_rows = 0;
  if (is_chunk_in_view && i < n) {
    const math::Vec3<float> mean = load_mean(attributes.mean, row);
    // Loads geometry before the depth is known: few Gaussians of a chunk in view are out of range, and the loads
    // overlap.
    const Geometry g = load_geometry(attributes, row);
    prefetch_color(attributes, row);
    auto p = project<kAnyModel>(v, mean, g);
    if (p.footprint.valid) {
      const auto columns = place_copy<kAnyModel, kTurboTile>(v, i, p);
      const float cutoff = math::power_cutoff(p.footprint.opacity);
      const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
      rect = math::bounding_tiles<kTurboTile>(ellipse, v.grid);
      if constexpr (kAnyModel) {
        rect.x0 = math::max(rect.x0, columns.first), rect.x1 = math::min(rect.x1, columns.last);
      }
      if (!rect.empty()) {
        n_columns = static_cast<std::uint32_t>(rect.x1 - rect.x0);
        n_rows = static_cast<std::uint32_t>(rect.y1 - rect.y0);
        s.ellipse[threadIdx.x] = ellipse;
        s.depth[threadIdx.x] = turbo_depth(p.z, v.view.near_plane);
        a.splats[i] = screen_splat(p, cutoff, color_of<kAnyModel>(attributes, row, v.view, mean, v.sh_degree));
      }
    }
  }
  const auto leave = [&] {
    set_aside(a.arrays, s.ellipse[threadIdx.x], rect, s.depth[threadIdx.x], i);
    n_columns = n_rows = 0;
  };
  if (n_columns * n_rows > kLargeTiles) leave();
  // Sums rows and candidates in one word.
  const std::uint32_t n_candidates = n_columns * n_rows;
  const std::uint32_t sums =
      inclusive_block_sum<kThreads>((n_rows > 0 ? n_rows - 1 : 0) | n_candidates << 16, s.places.warp_sums);
  const std::uint32_t candidates_end = sums >> 16, candidates_begin = candidates_end - n_candidates;
  s.row_end[threadIdx.x] = static_cast<std::uint16_t>(sums & 0xFFFFu);
  // Of the Gaussians whose candidates do not fit, the first writes how many fit.
  if (candidates_end > kCandidates) {
    if (candidates_begin <= kCandidates && n_candidates > 0) s.n_candidates = candidates_begin;
    if (n_candidates > 0) leave();
  } else if (threadIdx.x == kThreads - 1) {
    s.n_candidates = candidates_end;
  }
  s.box[threadIdx.x] = {static_cast<std::uint16_t>(rect.x0), static_cast<std::uint16_t>(rect.y0),
                        static_cast<std::uint16_t>(candidates_begin), static_cast<std::uint8_t>(n_columns),
                        static_cast<std::uint8_t>(n_rows)};
  const bool listed = n_rows > 0;
  const std::uint32_t bounds[4] = {warp_max(listed ? kOrigin - static_cast<std::uint32_t>(rect.x0) : 0),
                                   warp_max(listed ? kOrigin - static_cast<std::uint32_t>(rect.y0) : 0),
                                   warp_max(listed ? static_cast<std::uint32_t>(rect.x1) : 0),
                                   warp_max(listed ? static_cast<std::uint32_t>(rect.y1) : 0)};
  if (threadIdx.x % 32 == 0) {
#pragma unroll
    for (int k = 0; k < 4; ++k) atomicMax(s.bounds + k, bounds[k]);
  }
  __syncthreads();
  const std::uint32_t n_in_block = s.n_candidates;
  if (n_in_block == 0) return;
  const math::TileRect block{static_cast<int>(kOrigin - s.bounds[0]), static_cast<int>(kOrigin - s.bounds[1]),
                             static_cast<int>(s.bounds[2]), static_cast<int>(s.bounds[3])};
  const auto n_tiles = static_cast<std::uint32_t>((block.x1 - block.x0) * (block.y1 - block.y0));
  if (n_tiles > kBlockTiles) {
    if (n_rows > 0) leave();
    return;
  }

  fill_candidates(s, kThreads + s.row_end[kThreads - 1], block, [&s](std::uint32_t tile) {
    if (tile < kWindow) atomicAdd(s.counts + tile, 1u);
  });
  __syncthreads();
  for (std::uint32_t window = 0;;) {
    place_window(s, window, block, a.arrays, v.grid);
    for (std::uint32_t k = threadIdx.x; k < n_in_block; k += kThreads) {
      const std::uint32_t candidate = s.candidates[k], tile = tile_in(candidate) - window, owner = owner_in(candidate);
      if (cells_in(candidate) == 0 || tile >= kWindow) continue;
      s.listed[owner] = 1;
      const std::uint32_t at = atomicAdd(s.counts + tile, 1u);
      if (at < a.arrays.entry_capacity)
        a.arrays.entries[at] = make_entry(s.depth[owner], first + owner, cells_in(candidate), turbo_dropped_bits(n));
    }
    window += kWindow;
    if (window >= n_tiles) break;
    __syncthreads();
    clear_counts();
    __syncthreads();
    for (std::uint32_t k = threadIdx.x; k < n_in_block; k += kThreads) {
      const std::uint32_t candidate = s.candidates[k], tile = tile_in(candidate) - window;
      if (cells_in(candidate) != 0 && tile < kWindow) atomicAdd(s.counts + tile, 1u);
    }
    __syncthreads();
  }
  __syncthreads();
  const int visible = __syncthreads_count(s.listed[threadIdx.x] != 0);
  if (threadIdx.x == 0 && visible > 0) {
    atomic_add(a.arrays.state->counters.visible, static_cast<std::uint64_t>(visible));
  }
}

}  // namespace

Status launch_turbo_emit(const TurboEmitArguments& a, Stream stream) {
  if (a.n == 0) return {};
  const CullPlanes planes = cull_planes(a.view);
  std::visit(
      [&](const auto& attributes) {
        with_model(a.view.view, [&](auto any_model) {
          turbo_emit_kernel<any_model()><<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(attributes, planes, a);
        });
      },
      a.attributes);
  if (const auto ok = launched("the turbo front end could not be launched"); !ok) return ok;
  return launch_turbo_large_gaussians(a.arrays, a.view.grid, stream);
}

}  // namespace rgs::cuda
