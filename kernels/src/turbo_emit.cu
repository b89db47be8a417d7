// turbo_emit.cu - attributes to the entries of the tiles' lists, in runs of one tile each.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp
// In/Out  attributes [n] -> splats [n], entries [instances], runs
// Cost    as front_end.cu, with 8 B written an entry, and 16 B and two atomic additions a run
// Launch  256 threads, ceil(n / 256) blocks; then a warp a large Gaussian, as many warps as keep the device busy
// Shared  Shared: ellipses, the sums that map tile rows to their Gaussians, a counter for each tile of a window,
//         entries between counting and placing; 35 KiB
// Order   of entries and runs: any. The lists' order is made later, by depth and index, so that the image is the same
//         on every run. Compiled without contraction to FMA, see project.cu.
//
// Neighbours in a file are neighbours in space: a block's 256 Gaussians touch few tiles, many of them together. So the
// block sorts its entries by tile before they leave it, by counting. A window of 32x32 tiles is counted at a time; most
// blocks need one. What the rows have shown while they were counted is kept for placing, if there is room, in a word an
// entry. A Gaussian of many tiles would keep its block long after the others: it waits for a kernel of its own, where
// each of its entries is a run.
#include <cstdint>

#include "block_scan.cuh"
#include "cull_chunk.cuh"
#include "launch.cuh"
#include "load_splat.cuh"
#include "project_splat.cuh"
#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr int kWindow = 32;            // tiles along a window's side
constexpr int kLargeTiles = 64;       // of a bounding box that a block's own Gaussian may have
constexpr std::uint32_t kKept = 4096;  // entries of a window kept between counting and placing
constexpr int kLargeBlocks = 132 * 6;
constexpr int kTilesPerThread = kWindow * kWindow / kThreads;

struct Shared {
  math::Ellipse<float> ellipse[kThreads];
  std::uint32_t depth[kThreads];            // bits
  std::uint32_t row_end[kThreads];          // inclusive sums of the Gaussians' rows
  std::uint16_t first_row[kThreads];        // of each Gaussian
  std::uint8_t listed[kThreads];            // the Gaussian has an entry
  std::uint32_t counts[kWindow * kWindow];  // entries of each tile of the window; then the place of its next one
  std::uint32_t kept[kKept];                // tile in the window << 16 | owner << 8 | cells; 0: none
  std::uint32_t n_kept;                     // wanted, may be more than there is room for
  std::uint32_t warp_sums[kWarps];
  int bounds[4][kWarps];  // of the tiles that the block touches, from each warp: -x0, -y0, x1, y1
  std::uint64_t entry_base, run_base;
};

__device__ std::uint64_t add(std::uint64_t& to, std::uint64_t n) {
  return atomicAdd(reinterpret_cast<unsigned long long*>(&to), static_cast<unsigned long long>(n));
}

__device__ TurboEntry make_entry(std::uint32_t depth, std::uint32_t index, std::uint32_t cells) {
  return static_cast<std::uint64_t>(depth) << (kTurboIndexBits + 8) | static_cast<std::uint64_t>(index) << 8 | cells;
}

// Tiles of the window that starts at (column, row), which the block's rows meet.
struct Window {
  int column, row;
};

// Calls f(owner, tiles, cells, first column) for every tile row of the block's Gaussians that the window meets; tiles
// are those columns of the window that the row may touch.
template <class F>
__device__ void for_each_row(const Shared& s, std::uint32_t n_rows, Window window, math::TileGrid grid, const F& f) {
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    const std::uint32_t owner = owner_of<kThreads>(s.row_end, r);
    const std::uint32_t begin = owner == 0 ? 0 : s.row_end[owner - 1];
    const int row = s.first_row[owner] + static_cast<int>(r - begin);
    if (row < window.row || row >= window.row + kWindow) continue;
    const auto cells = math::cell_rows(s.ellipse[owner], row);
    const auto span = math::tiles_of(cells, grid);
    const math::TileSpan inside{math::max(span.first, window.column), math::min(span.last, window.column + kWindow)};
    if (inside.first >= inside.last) continue;
    f(owner, inside, cells, static_cast<std::uint32_t>((row - window.row) * kWindow - window.column));
  }
}

// Entries and runs of the window's tiles get their places; counts become the entries' positions after s.entry_base.
__device__ void place_window(Shared& s, Window window, const TurboArrays& out, math::TileGrid grid) {
  // Both sums in one word: at most 2^18 entries and 2^10 runs.
  constexpr int kRunShift = 20;
  std::uint32_t counts[kTilesPerThread];
  std::uint32_t sum = 0;
#pragma unroll
  for (int k = 0; k < kTilesPerThread; ++k) {
    counts[k] = s.counts[kTilesPerThread * threadIdx.x + k];
    sum += counts[k] + (counts[k] > 0 ? 1u << kRunShift : 0);
  }
  const std::uint32_t end = inclusive_block_sum<kThreads>(sum, s.warp_sums);
  if (threadIdx.x == kThreads - 1) {
    TurboState& state = *out.state;
    s.entry_base = add(state.counters.instances, end & ((1u << kRunShift) - 1));
    s.run_base = add(state.runs, end >> kRunShift);
  }
  __syncthreads();
  std::uint32_t at = (end - sum) & ((1u << kRunShift) - 1);
  std::uint64_t run = s.run_base + ((end - sum) >> kRunShift);
  auto* const n_entries = reinterpret_cast<std::uint32_t*>(out.state + 1);
  std::uint32_t* const n_runs = n_entries + out.n_tiles;
#pragma unroll
  for (int k = 0; k < kTilesPerThread; ++k) {
    const int in_window = kTilesPerThread * static_cast<int>(threadIdx.x) + k;
    s.counts[in_window] = at;
    if (counts[k] == 0) continue;
    const auto tile = static_cast<std::uint32_t>((window.row + in_window / kWindow) * grid.columns + window.column +
                                                 in_window % kWindow);
    atomicAdd(n_entries + tile, counts[k]);
    const std::uint32_t rank = atomicAdd(n_runs + tile, 1u);
    if (run < out.run_capacity) {
      out.runs[run] = {{static_cast<std::uint32_t>(s.entry_base) + at, counts[k]}, tile, rank};
    }
    at += counts[k];
    ++run;
  }
  __syncthreads();
}

template <class A>
__global__ void __launch_bounds__(kThreads) turbo_emit_kernel(A attributes, TurboEmitArguments a) {
  __shared__ Shared memory;
  Shared& s = memory;
  const ViewParameters& v = a.view;
  const std::uint32_t first = blockIdx.x * kThreads;
  const std::uint32_t i = first + threadIdx.x;
  s.listed[threadIdx.x] = 0;

  std::uint32_t rows = 0;
  math::TileRect rect{0x7FFF, 0x7FFF, 0, 0};
  if (i < a.n && chunk_in_view(attributes, i, v)) {
    const math::Vec3<float> mean = load_mean(attributes.mean, i);
    const auto p = project_splat(attributes, i, v, mean);
    if (p.footprint.valid) {
      const float cutoff = math::power_cutoff(p.footprint.opacity);
      const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
      const auto touched = math::bounding_tiles<kTurboTile>(ellipse, v.grid);
      if (!touched.empty()) {
        const int touched_rows = touched.y1 - touched.y0;
        if (touched_rows * (touched.x1 - touched.x0) > kLargeTiles) {
          const std::uint32_t at = atomicAdd(&a.arrays.state->n_large, 1u);
          if (at < a.arrays.large_capacity) {
            a.arrays.large[at] = {ellipse,
                                  math::depth_bits(p.z),
                                  i,
                                  static_cast<std::uint16_t>(touched.y0),
                                  static_cast<std::uint16_t>(touched_rows),
                                  {}};
          }
        } else {
          rect = touched;
          rows = static_cast<std::uint32_t>(touched_rows);
          s.ellipse[threadIdx.x] = ellipse;
          s.first_row[threadIdx.x] = static_cast<std::uint16_t>(rect.y0);
          s.depth[threadIdx.x] = math::depth_bits(p.z);
        }
        a.splats[i] = screen_splat(p, cutoff, color_of(attributes, i, v.view, mean, v.sh_degree));
      }
    }
  }
  const auto larger = [](int x, int y) { return math::max(x, y); };
  const int bounds[4] = {reduce_warp(-rect.x0, larger), reduce_warp(-rect.y0, larger), reduce_warp(rect.x1, larger),
                         reduce_warp(rect.y1, larger)};
  if (threadIdx.x % 32 == 0) {
    for (int k = 0; k < 4; ++k) s.bounds[k][threadIdx.x / 32] = bounds[k];
  }
  s.row_end[threadIdx.x] = inclusive_block_sum<kThreads>(rows, s.warp_sums);
  __syncthreads();
  const std::uint32_t n_rows = s.row_end[kThreads - 1];
  if (n_rows == 0) return;
  int all[4] = {-0x7FFF, -0x7FFF, 0, 0};
  for (int k = 0; k < 4; ++k) {
    for (const int bound : s.bounds[k]) all[k] = math::max(all[k], bound);
  }

  for (Window window{-all[0], -all[1]}; window.row < all[3];) {
    for (int k = 0; k < kTilesPerThread; ++k) s.counts[kThreads * k + threadIdx.x] = 0;
    if (threadIdx.x == 0) s.n_kept = 0;
    __syncthreads();
    for_each_row(s, n_rows, window, v.grid,
                 [&s](std::uint32_t owner, math::TileSpan span, const math::CellRows<float>& cells, std::uint32_t row) {
                   std::uint32_t at = atomicAdd(&s.n_kept, static_cast<std::uint32_t>(span.last - span.first));
                   for (int column = span.first; column < span.last; ++column, ++at) {
                     const std::uint32_t touched = math::cells_of(cells, column);
                     const std::uint32_t tile = row + static_cast<std::uint32_t>(column);
                     if (touched != 0) atomicAdd(s.counts + tile, 1u);
                     if (at < kKept) s.kept[at] = touched == 0 ? 0 : tile << 16 | owner << 8 | touched;
                   }
                 });
    __syncthreads();
    place_window(s, window, a.arrays, v.grid);
    const std::uint64_t base = s.entry_base;
    const auto place = [&](std::uint32_t tile, std::uint32_t owner, std::uint32_t cells) {
      s.listed[owner] = 1;
      const std::uint64_t at = base + atomicAdd(s.counts + tile, 1u);
      if (at < a.arrays.entry_capacity) a.arrays.entries[at] = make_entry(s.depth[owner], first + owner, cells);
    };
    if (s.n_kept <= kKept) {
      for (std::uint32_t k = threadIdx.x; k < s.n_kept; k += kThreads) {
        const std::uint32_t kept = s.kept[k];
        if (kept != 0) place(kept >> 16, kept >> 8 & 0xFF, kept & 0xFF);
      }
    } else {
      for_each_row(
          s, n_rows, window, v.grid,
          [&](std::uint32_t owner, math::TileSpan span, const math::CellRows<float>& cells, std::uint32_t row) {
            for (int column = span.first; column < span.last; ++column) {
              const std::uint32_t touched = math::cells_of(cells, column);
              if (touched != 0) place(row + static_cast<std::uint32_t>(column), owner, touched);
            }
          });
    }
    window.column += kWindow;
    if (window.column >= all[2]) window = {-all[0], window.row + kWindow};
    __syncthreads();
  }
  const int visible = __syncthreads_count(s.listed[threadIdx.x] != 0);
  if (threadIdx.x == 0 && visible > 0) {
    add(a.arrays.state->counters.visible, static_cast<std::uint64_t>(visible));
  }
}

// Rows of a large Gaussian, up to one a lane.
struct LargeRows {
  math::CellRows<float> cells[32];
  int first_column[32];
  std::uint32_t tile_end[32];  // inclusive sums of their tiles
};

__global__ void __launch_bounds__(kThreads, 4) turbo_emit_large_kernel(math::TileGrid grid, TurboArrays a) {
  __shared__ LargeRows all_rows[kWarps];
  LargeRows& rows = all_rows[threadIdx.x / 32];
  const std::uint32_t lane = threadIdx.x % 32;
  const std::uint32_t n = math::min(a.state->n_large, static_cast<std::uint32_t>(a.large_capacity));
  auto* const n_entries = reinterpret_cast<std::uint32_t*>(a.state + 1);
  std::uint32_t* const n_runs = n_entries + a.n_tiles;
  std::uint32_t visible = 0;
  for (std::uint32_t k = (blockIdx.x * kThreads + threadIdx.x) / 32; k < n; k += gridDim.x * kWarps) {
    const TurboLarge large = a.large[k];
    bool touches = false;
    for (int begin = 0; begin < large.n_rows; begin += 32) {
      std::uint32_t tiles = 0;
      const int own = begin + static_cast<int>(lane);
      if (own < large.n_rows) {
        const auto cells = math::cell_rows(large.ellipse, large.first_row + own);
        const auto span = math::tiles_of(cells, grid);
        rows.cells[lane] = cells;
        rows.first_column[lane] = span.first;
        tiles = static_cast<std::uint32_t>(math::max(span.last - span.first, 0));
      }
      const std::uint32_t end = inclusive_warp_sum(tiles);
      rows.tile_end[lane] = end;
      const std::uint32_t n_tiles = __shfl_sync(kFullWarp, end, 31);
      __syncwarp();
      // Warps begin at different tiles: the large ones touch the same, and additions to one counter wait for each other.
      const std::uint32_t n_parts = (n_tiles + 31) / 32, turn = n_parts > 0 ? k % n_parts : 0;
      // Between the first and the last tile of a row there may be one without a cell, so cells are counted first.
      const auto for_each = [&](const auto& f) {
        for (std::uint32_t j = 0; j < n_parts; ++j) {
          const std::uint32_t t = (j + turn < n_parts ? j + turn : j + turn - n_parts) * 32 + lane;
          std::uint32_t cells = 0, tile = 0;
          if (t < n_tiles) {
            const std::uint32_t r = owner_of<32>(rows.tile_end, t);
            const int column = rows.first_column[r] + static_cast<int>(t - (r == 0 ? 0 : rows.tile_end[r - 1]));
            const int row = large.first_row + begin + static_cast<int>(r);
            cells = math::cells_of(rows.cells[r], column);
            tile = static_cast<std::uint32_t>(row * grid.columns + column);
          }
          f(tile, cells, __ballot_sync(kFullWarp, cells != 0));
        }
      };
      std::uint32_t total = 0;
      for_each([&total](std::uint32_t, std::uint32_t, std::uint32_t lanes) {
        total += static_cast<std::uint32_t>(__popc(static_cast<int>(lanes)));
      });
      if (total > 0) {
        touches = true;
        std::uint64_t base = 0;  // of the entries in lane 0, of the runs in lane 1
        if (lane < 2) base = add(lane == 0 ? a.state->counters.instances : a.state->runs, total);
        std::uint64_t entry = __shfl_sync(kFullWarp, base, 0), run = __shfl_sync(kFullWarp, base, 1);
        for_each([&](std::uint32_t tile, std::uint32_t cells, std::uint32_t lanes) {
          const auto before = static_cast<std::uint32_t>(__popc(static_cast<int>(lanes & ((1u << lane) - 1))));
          if (cells != 0) {
            atomicAdd(n_entries + tile, 1u);
            const std::uint32_t rank = atomicAdd(n_runs + tile, 1u);
            if (entry + before < a.entry_capacity && run + before < a.run_capacity) {
              a.entries[entry + before] = make_entry(large.depth, large.index, cells);
              a.runs[run + before] = {{static_cast<std::uint32_t>(entry) + before, 1}, tile, rank};
            }
          }
          const auto n_lanes = static_cast<std::uint32_t>(__popc(static_cast<int>(lanes)));
          entry += n_lanes, run += n_lanes;
        });
      }
      __syncwarp();
    }
    visible += touches ? 1 : 0;
  }
  if (lane == 0 && visible > 0) add(a.state->counters.visible, visible);
}

}  // namespace

Status launch_turbo_emit(const TurboEmitArguments& a, Stream stream) {
  if (a.n == 0) return {};
  std::visit(
      [&](const auto& attributes) {
        turbo_emit_kernel<<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(attributes, a);
      },
      a.attributes);
  turbo_emit_large_kernel<<<kLargeBlocks, kThreads, 0, stream>>>(a.view.grid, a.arrays);
  return launched("the turbo front end could not be launched");
}

}  // namespace rgs::cuda
