// turbo_emit.cu - attributes to the entries of the tiles' lists, in runs of one tile each.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp
// In/Out  attributes [n] -> splats [n], entries, runs; entries of large Gaussians are counted only
// Cost    as front_end.cu, with 8 B written an entry, and 16 B and an atomic addition a run
// Launch  256 threads, ceil(n / 256) blocks; then a thread a row of a large Gaussian's part, as many blocks as keep the
//         device busy
// Shared  Shared: ellipses and boxes, the sums that map tile rows to their Gaussians, a counter for each tile of a
//         window, entries between counting and placing; 29 KiB
// Order   of entries and runs: any. The lists' order is made later, by depth and index, so that the image is the same
//         on every run. Compiled without contraction to FMA, see project.cu.
//
// Neighbours in a file are neighbours in space: a block's 256 Gaussians touch few tiles, many of them together. So the
// block sorts its entries by tile before they leave it, by counting. A window of at most 1,024 tiles is counted at a
// time; most blocks need one. What the rows have shown while they were counted is kept for placing, if there is room, in
// a word for each tile of a Gaussian's bounding box. A Gaussian of many tiles would keep its block long after the others:
// it waits, cut in parts, for a kernel that counts its entries; turbo_lists.cu places them.
#include <cstdint>

#include "block_scan.cuh"
#include "cull_chunk.cuh"
#include "large_tiles.cuh"
#include "launch.cuh"
#include "load_splat.cuh"
#include "project_splat.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr int kWindow = 32;  // tiles along a window's side, if one of another shape does not hold all
constexpr int kWindowTiles = kWindow * kWindow;
constexpr int kLargeTiles = 64;        // of a bounding box that a block's own Gaussian may have
constexpr std::uint32_t kKept = 3072;  // tiles kept between counting and placing
constexpr int kCountBlocks = 132 * 4;

// Tiles of a Gaussian's bounding box.
struct Box {
  std::uint16_t x, y;
  std::uint16_t first;  // of its words among the block's
  std::uint8_t columns, rows;
};
static_assert(kLargeTiles < 256 && kThreads * kLargeTiles < 1 << 15);

struct Shared {
  math::Ellipse<float> ellipse[kThreads];
  Box box[kThreads];
  std::uint32_t depth[kThreads];      // bits
  std::uint16_t row_end[kThreads];    // inclusive sums of the Gaussians' rows after the first
  std::uint8_t listed[kThreads];      // the Gaussian has an entry
  std::uint32_t counts[kWindowTiles]; // entries of each tile of the window; then the place of its next one
  std::uint32_t kept[kKept];          // tile in the window << 16 | owner << 8 | cells; without cells: none
  std::uint32_t n_words;              // wanted, may be more than there is room for
  std::uint32_t warp_sums[kWarps];
  std::uint32_t bounds[4][kWarps];  // of the tiles that the block touches, from each warp: -x0, -y0, x1, y1
  std::uint64_t entry_base, run_base;
};

__device__ std::uint64_t add(std::uint64_t& to, std::uint64_t n) {
  return atomicAdd(reinterpret_cast<unsigned long long*>(&to), static_cast<unsigned long long>(n));
}

// Tiles that are counted together.
struct Window {
  int column, row, columns, rows;
};

// Calls f(word, owner, tile in the window, cells) for every tile of the block's bounding boxes; cells are 0 where the
// Gaussian does not touch the tile, or it is not in the window. The first rows of the 256 Gaussians come first, a thread
// each, then all other rows side by side.
template <class F>
__device__ void for_each_tile(const Shared& s, std::uint32_t n_rows, const Window& w, math::TileGrid grid, const F& f) {
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    std::uint32_t owner = r, row = 0;
    if (r >= kThreads) {
      owner = owner_of<kThreads>(s.row_end, r - kThreads);
      row = r - kThreads - (owner == 0 ? 0 : s.row_end[owner - 1]) + 1;
    }
    const Box box = s.box[owner];
    if (row >= box.rows) continue;
    const int y = box.y + static_cast<int>(row);
    const auto cells = math::cell_rows(s.ellipse[owner], y, grid);
    const bool row_inside = static_cast<std::uint32_t>(y - w.row) < static_cast<std::uint32_t>(w.rows);
    const std::uint32_t word = box.first + row * box.columns;
    const int x = box.x - w.column;
    const int tile = (y - w.row) * w.columns + x;
    std::uint32_t four = 0;
    for (int k = 0; k < box.columns; ++k, four >>= 2) {
      if (k % 4 == 0) four = math::cells_of_four(cells, box.x + k);
      const bool inside = row_inside && static_cast<std::uint32_t>(x + k) < static_cast<std::uint32_t>(w.columns);
      f(word + static_cast<std::uint32_t>(k), owner, static_cast<std::uint32_t>(tile + k),
        inside ? math::cells_of_first(four) : 0);
    }
  }
}

// Entries and runs of the window's tiles get their places; counts become the places of the tiles' first entries.
__device__ void place_window(Shared& s, const Window& w, const TurboArrays& out, math::TileGrid grid) {
  const int n_tiles = w.columns * w.rows;
  for (int first = 0; first < n_tiles; first += kThreads) {
    const int in_window = first + static_cast<int>(threadIdx.x);
    const std::uint32_t n = in_window < n_tiles ? s.counts[in_window] : 0;
    // Sums of entries and of runs in one word.
    const std::uint32_t end = inclusive_block_sum<kThreads>(n | (n > 0 ? 1u << 16 : 0), s.warp_sums);
    if (threadIdx.x == kThreads - 1) {
      s.entry_base = add(out.state->counters.instances, end & 0xFFFFu);
      s.run_base = add(out.state->runs, end >> 16);
    }
    __syncthreads();
    if (n > 0) {
      const std::uint32_t at = static_cast<std::uint32_t>(s.entry_base) + (end & 0xFFFFu) - n;
      s.counts[in_window] = at;
      const int row = in_window / w.columns;
      const auto tile = static_cast<std::uint32_t>((w.row + row) * grid.columns + w.column + in_window - row * w.columns);
      const std::uint64_t counted = atomicAdd(TileCounts::of(out).block + tile, std::uint64_t{1} << 32 | n);
      const std::uint64_t run = s.run_base + (end >> 16) - 1;
      if (run < out.run_capacity) out.runs[run] = {{at, n}, tile, static_cast<std::uint32_t>(counted >> 32)};
    }
    __syncthreads();
  }
}

// Leaves a large Gaussian, in parts, to the kernels that take them.
__device__ void set_aside(const TurboArrays& out, const math::Ellipse<float>& ellipse, const math::TileRect& rect,
                          std::uint32_t depth, std::uint32_t i) {
  const int n_down = (rect.y1 - rect.y0 + kTurboLargeRows - 1) / kTurboLargeRows;
  const int n_across = (rect.x1 - rect.x0 + kTurboLargeColumns - 1) / kTurboLargeColumns;
  const std::uint32_t leader = atomicAdd(&out.state->n_large, static_cast<std::uint32_t>(n_down * n_across));
  std::uint32_t at = leader;
  for (int y = rect.y0; y < rect.y1; y += kTurboLargeRows) {
    for (int x = rect.x0; x < rect.x1; x += kTurboLargeColumns, ++at) {
      if (at >= out.large_capacity) return;
      out.large[at] = {ellipse,
                       depth,
                       i,
                       leader,
                       0,
                       static_cast<std::uint16_t>(y),
                       static_cast<std::uint16_t>(math::min(rect.y1 - y, kTurboLargeRows)),
                       static_cast<std::uint16_t>(x),
                       static_cast<std::uint16_t>(math::min(rect.x1 - x, kTurboLargeColumns)),
                       0};
    }
  }
}

template <class A>
__global__ void __launch_bounds__(kThreads)
    turbo_emit_kernel(A attributes, CullPlanes planes, TurboEmitArguments a) {
  __shared__ Shared memory;
  Shared& s = memory;
  const ViewParameters& v = a.view;
  const std::uint32_t first = blockIdx.x * kThreads;
  const std::uint32_t i = first + threadIdx.x;
  const auto clear_counts = [&s] {
    static_assert(kWindowTiles == 4 * kThreads);
    reinterpret_cast<uint4*>(s.counts)[threadIdx.x] = {};
  };
  clear_counts();
  s.listed[threadIdx.x] = 0;

  math::TileRect rect{0x7FFF, 0x7FFF, 0, 0};
  std::uint32_t n_columns = 0, n_rows = 0;
  if (i < a.n && chunk_in_view(attributes, i, planes)) {
    const math::Vec3<float> mean = load_mean(attributes.mean, i);
    const auto p = project_splat(attributes, i, v, mean);
    if (p.footprint.valid) {
      const float cutoff = math::power_cutoff(p.footprint.opacity);
      const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
      const auto touched = math::bounding_tiles<kTurboTile>(ellipse, v.grid);
      if (!touched.empty()) {
        const std::uint32_t depth = math::depth_bits(p.z);
        const int columns = touched.x1 - touched.x0, rows = touched.y1 - touched.y0;
        if (columns * rows > kLargeTiles) {
          set_aside(a.arrays, ellipse, touched, depth, i);
        } else {
          rect = touched;
          n_columns = static_cast<std::uint32_t>(columns), n_rows = static_cast<std::uint32_t>(rows);
          s.ellipse[threadIdx.x] = ellipse;
          s.depth[threadIdx.x] = depth;
        }
        a.splats[i] = screen_splat(p, cutoff, color_of(attributes, i, v.view, mean, v.sh_degree));
      }
    }
  }
  // Sums of rows and of words in one.
  const std::uint32_t n_words = n_columns * n_rows;
  const std::uint32_t sums =
      inclusive_block_sum<kThreads>((n_rows > 0 ? n_rows - 1 : 0) | n_words << 16, s.warp_sums);
  s.row_end[threadIdx.x] = static_cast<std::uint16_t>(sums & 0xFFFFu);
  s.box[threadIdx.x] = {static_cast<std::uint16_t>(rect.x0),
                        static_cast<std::uint16_t>(rect.y0),
                        static_cast<std::uint16_t>((sums >> 16) - n_words),
                        static_cast<std::uint8_t>(n_columns),
                        static_cast<std::uint8_t>(n_rows)};
  if (threadIdx.x == kThreads - 1) s.n_words = sums >> 16;
  const std::uint32_t bounds[4] = {warp_max(static_cast<std::uint32_t>(0x7FFF - rect.x0)),
                                   warp_max(static_cast<std::uint32_t>(0x7FFF - rect.y0)),
                                   warp_max(static_cast<std::uint32_t>(rect.x1)),
                                   warp_max(static_cast<std::uint32_t>(rect.y1))};
  if (threadIdx.x % 32 == 0) {
    for (int k = 0; k < 4; ++k) s.bounds[k][threadIdx.x / 32] = bounds[k];
  }
  __syncthreads();
  if (s.n_words == 0) return;
  int all[4] = {};
  for (int k = 0; k < 4; ++k) {
    for (const std::uint32_t bound : s.bounds[k]) all[k] = math::max(all[k], static_cast<int>(bound));
  }
  const math::TileRect block{0x7FFF - all[0], 0x7FFF - all[1], all[2], all[3]};
  const std::uint32_t n_all_rows = kThreads + s.row_end[kThreads - 1];
  const bool keep = s.n_words <= kKept;

  Window w{block.x0, block.y0, block.x1 - block.x0, block.y1 - block.y0};
  if (w.columns * w.rows > kWindowTiles) w.columns = w.rows = kWindow;
  for (; w.row < block.y1; w.row += w.rows) {
    for (w.column = block.x0; w.column < block.x1; w.column += w.columns) {
      for_each_tile(s, n_all_rows, w, v.grid,
                    [&s, keep](std::uint32_t word, std::uint32_t owner, std::uint32_t tile, std::uint32_t cells) {
                      if (cells != 0) atomicAdd(s.counts + tile, 1u);
                      if (keep) s.kept[word] = tile << 16 | owner << 8 | cells;
                    });
      __syncthreads();
      place_window(s, w, a.arrays, v.grid);
      const auto place = [&](std::uint32_t owner, std::uint32_t tile, std::uint32_t cells) {
        if (cells == 0) return;
        s.listed[owner] = 1;
        const std::uint32_t at = atomicAdd(s.counts + tile, 1u);
        if (at < a.arrays.entry_capacity) a.arrays.entries[at] = make_entry(s.depth[owner], first + owner, cells);
      };
      if (keep) {
        for (std::uint32_t k = threadIdx.x; k < s.n_words; k += kThreads) {
          const std::uint32_t kept = s.kept[k];
          place(kept >> 8 & 0xFFu, kept >> 16, kept & 0xFFu);
        }
      } else {
        for_each_tile(s, n_all_rows, w, v.grid,
                      [&place](std::uint32_t, std::uint32_t owner, std::uint32_t tile, std::uint32_t cells) {
                        place(owner, tile, cells);
                      });
      }
      __syncthreads();
      clear_counts();
      __syncthreads();
    }
  }
  const int visible = __syncthreads_count(s.listed[threadIdx.x] != 0);
  if (threadIdx.x == 0 && visible > 0) {
    add(a.arrays.state->counters.visible, static_cast<std::uint64_t>(visible));
  }
}

__global__ void __launch_bounds__(kThreads) turbo_count_large_kernel(math::TileGrid grid, TurboArrays a) {
  __shared__ std::uint32_t sums[2];
  if (threadIdx.x < 2) sums[threadIdx.x] = 0;
  __syncthreads();
  std::uint32_t n_entries = 0, n_visible = 0;
  for_each_large_row<kThreads>(a, blockIdx.x, gridDim.x, [&](std::uint32_t at, std::uint32_t row, bool valid) {
    const std::uint32_t before = n_entries;
    TurboLarge part{};
    if (valid) part = a.large[at];
    if (row < part.n_rows) {
      for_each_large_tiles(part, row, grid, [&](std::uint32_t tile, const std::uint32_t(&cells)[4]) {
#pragma unroll
        for (std::uint32_t k = 0; k < 4; ++k) {
          if (cells[k] == 0) continue;
          atomicAdd(TileCounts::of(a).large + tile + k, 1u);
          ++n_entries;
        }
      });
    }
    const std::uint32_t lanes = __ballot_sync(kFullWarp, n_entries > before);
    const std::uint32_t of_part = ((1u << kTurboLargeRows) - 1) << (threadIdx.x % 32 / kTurboLargeRows * kTurboLargeRows);
    if (row == 0 && (lanes & of_part) != 0 && atomicExch(&a.large[part.leader].listed, 1u) == 0) ++n_visible;
  });
  atomicAdd(sums, n_entries);
  if (n_visible > 0) atomicAdd(sums + 1, n_visible);
  __syncthreads();
  if (threadIdx.x == 0 && sums[0] > 0) add(a.state->large_entries, sums[0]);
  if (threadIdx.x == 1 && sums[1] > 0) add(a.state->counters.visible, sums[1]);
}

}  // namespace

Status launch_turbo_emit(const TurboEmitArguments& a, Stream stream) {
  if (a.n == 0) return {};
  const CullPlanes planes = cull_planes(a.view);
  std::visit(
      [&](const auto& attributes) {
        turbo_emit_kernel<<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(attributes, planes, a);
      },
      a.attributes);
  turbo_count_large_kernel<<<kCountBlocks, kThreads, 0, stream>>>(a.view.grid, a.arrays);
  return launched("the turbo front end could not be launched");
}

}  // namespace rgs::cuda
