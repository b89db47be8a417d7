// turbo_emit.cu - turns attributes into entries of the tiles' lists, in runs of one tile each.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp; turbo_geometry.hpp
// In/Out  attributes -> splats [n], entries, runs, large
// Cost    as front_end.cu, with 8 B written an entry, and 16 B and an atomic addition a run
// Launch  256 threads, ceil(n / 256) blocks, of very many Gaussians half as many; with levels n is a capacity. Blocks
//         beyond the drawn rows end at once; of pinholes, where chunks are multiples of 256 Gaussians, those out of the
//         view too
// Shared  Shared: ellipses and boxes, the sums that map tile rows to their Gaussians, a counter for each tile of a window,
//         candidates between counting and placing; 33 or 44 KiB
// Order   entries and runs: any. Lists are ordered later, by depth and index, so the image is the same on every run.
//         Compiled without contraction to FMA, see project.cu.
//
// Neighbours in a file are neighbours in space: a block's 256 or 512 Gaussians touch few tiles, many of them together.
// So the block sorts its entries by tile, by counting, before it writes them. Meanwhile it keeps what their rows show
// as candidates, one for each tile of a Gaussian's bounding box. The tiles of the block's own bounding box are counted
// 1,024 at a time; most blocks have fewer. A Gaussian of many tiles, which would delay its block, is left to
// turbo_large_gaussians.cu, as is one whose candidates do not fit.
#include <bit>
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
// Blocks of two Gaussians a thread do less for each, but the last ones run alone: only where a multiprocessor gets so
// many.
constexpr std::uint32_t kBlocksOfPairs = 64;

struct Box {
  std::uint16_t x, y;
  std::uint16_t first;  // its first candidate
  std::uint8_t columns, rows;
};
static_assert(kLargeTiles < 256 && 2 * kThreads * kLargeTiles < 1 << 16);

// A candidate entry: a tile of a Gaussian's bounding box, numbered within the block's box; the owner among the block's
// Gaussians; and the touched cells of the tile, none if it has no entry.
template <std::uint32_t kPerThread>
struct Candidate {
  static constexpr int kOwnerBits = std::bit_width(kPerThread * kThreads - 1);
  static constexpr int kOwnerAt = kTurboCellBits, kTileAt = kOwnerAt + kOwnerBits;
  static constexpr std::uint32_t kTiles = 1u << (32 - kTileAt);  // that it can address

  std::uint32_t word;

  __device__ static Candidate of(std::uint32_t tile, std::uint32_t owner, std::uint32_t cells) {
    return {tile << kTileAt | owner << kOwnerAt | cells};
  }
  __device__ std::uint32_t tile() const { return word >> kTileAt; }
  __device__ std::uint32_t owner() const { return word >> kOwnerAt & ((1u << kOwnerBits) - 1); }
  __device__ std::uint32_t cells() const { return word & ((1u << kTurboCellBits) - 1); }
};

// Of blocks of kPerThread Gaussians a thread.
template <std::uint32_t kPerThread>
struct Shared {
  static constexpr std::uint32_t kGaussians = kPerThread * kThreads;
  static constexpr std::uint32_t kCandidates =
      kPerThread == 1 ? 4096 : 3808;  // five blocks fit a multiprocessor of 9.0

  math::Ellipse<float> ellipse[kGaussians];
  Box box[kGaussians];
  std::uint32_t depth[kGaussians];            // turbo_depth()
  std::uint16_t row_end[kGaussians];          // inclusive sums of the Gaussians' rows after the first
  std::uint8_t listed[kGaussians];            // the Gaussian has an entry
  alignas(16) std::uint32_t counts[kWindow];  // entries of each tile of the window; then the place of the next one
  Candidate<kPerThread> candidates[kCandidates];
  std::uint32_t n_candidates;
  std::uint32_t bounds[4];  // of the block: largest 2^15 - x0, 2^15 - y0, x1, y1
  RunPlaces<kThreads> places;

  // A thread's Gaussians are neighbours here, and kThreads apart in memory.
  __device__ static std::uint32_t place_of(std::uint32_t owner) {
    return owner % kPerThread * kThreads + owner / kPerThread;
  }
};
// Given by 128 bytes, 1 KiB more a block, of 228 KiB.
static_assert(5 * ((sizeof(Shared<2>) + 1024 + 127) / 128 * 128) <= 228 * 1024, "five blocks a multiprocessor of 9.0");
constexpr std::uint32_t kOrigin = 1u << 15;

// Fills in the candidates and calls f(tile) for every entry among them: first the first rows of all Gaussians, a
// thread each, then all other rows side by side.
template <std::uint32_t kPerThread, class F>
__device__ void fill_candidates(Shared<kPerThread>& s, std::uint32_t n_rows, const math::TileRect& block, const F& f) {
  constexpr std::uint32_t kGaussians = Shared<kPerThread>::kGaussians;
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    std::uint32_t owner = r, row = 0;
    if (r >= kGaussians) {
      owner = owner_of<kGaussians>(s.row_end, r - kGaussians);
      row = r - kGaussians - (owner == 0 ? 0 : s.row_end[owner - 1]) + 1;
    }
    const Box box = s.box[owner];
    if (row >= box.rows) continue;
    const int y = box.y + static_cast<int>(row);
    const auto cells = cell_rows(s.ellipse[owner], y);
    Candidate<kPerThread>* const own = s.candidates + box.first + row * box.columns;
    const auto first = static_cast<std::uint32_t>((y - block.y0) * (block.x1 - block.x0) + box.x - block.x0);
    for (std::uint32_t k = 0; k < box.columns; k += kTurboStripTiles) {
      const std::uint32_t strip = cells_of_strip(cells, box.x + static_cast<int>(k));
#pragma unroll
      for (std::uint32_t j = 0; j < kTurboStripTiles; ++j) {
        if (k + j >= box.columns) break;
        const std::uint32_t touched = cells_in_strip(strip, static_cast<int>(j)), tile = first + k + j;
        own[k + j] = Candidate<kPerThread>::of(tile, owner, touched);
        if (touched != 0) f(tile);
      }
    }
  }
}

// Reserves the window's entries and runs; counts become the places of the tiles' first entries.
template <std::uint32_t kPerThread>
__device__ void place_window(Shared<kPerThread>& s, std::uint32_t window, const math::TileRect& block,
                             const TurboArrays& out, math::TileGrid grid) {
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

template <bool kAnyModel, std::uint32_t kPerThread, class A>
__global__ void __launch_bounds__(kThreads, resident_on_90(kAnyModel ? 0 : 5))
    turbo_emit_kernel(A attributes, const __grid_constant__ CullPlanes planes, TurboEmitArguments a) {
  using S = Shared<kPerThread>;
  constexpr std::uint32_t kGaussians = S::kGaussians, kCandidates = S::kCandidates;
  __shared__ S memory;
  S& s = memory;
  const ViewParameters& v = a.view;
  const std::uint32_t first = blockIdx.x * kGaussians;
  // Of splats; with levels, of the drawn rows'.
  std::uint32_t n = a.n;
  if constexpr (std::is_same_v<A, PagedAttributes>) {
    n = n_drawn_rows(a.drawn, attributes.chunk_size) * math::n_copies(v.view);
    if (first >= n) return;
  }
  if (first == 0 && threadIdx.x == 0) a.arrays.state->dropped = turbo_dropped_bits(n);
  // Bit g: the chunk of the thread's Gaussian g is in view, as far as is known.
  std::uint32_t in_view = (1u << kPerThread) - 1;
  if constexpr (!kAnyModel && std::is_same_v<A, CompactAttributes>) {
    const auto is_in_view = [&](std::uint32_t i) {
      return chunk_in_view(attributes, math::min(i, n - 1), v.view, planes);
    };
    if (attributes.chunk_size % kThreads == 0) {
      // Warp g tests chunk g, and 1 << g of its threads are counted.
      const std::uint32_t warp = threadIdx.x / 32;
      const bool own = warp < kPerThread && is_in_view(first + warp * kThreads);
      in_view = static_cast<std::uint32_t>(__syncthreads_count(own && threadIdx.x % 32 < 1u << warp));
      if (in_view == 0) return;
    } else {
      in_view = 0;
      for (std::uint32_t g = 0; g < kPerThread; ++g)
        in_view |= is_in_view(first + g * kThreads + threadIdx.x) ? 1u << g : 0;
    }
  }
  const auto clear_counts = [&s] {
    static_assert(kWindow == 4 * kThreads);
    reinterpret_cast<uint4*>(s.counts)[threadIdx.x] = {};
  };
  clear_counts();
  for (std::uint32_t g = 0; g < kPerThread; ++g) s.listed[g * kThreads + threadIdx.x] = 0;
  if (threadIdx.x < 4) s.bounds[threadIdx.x] = 0;

  const auto leave = [&](std::uint32_t owner) {
    const Box box = s.box[owner];
    set_aside(a.arrays, s.ellipse[owner], {box.x, box.y, box.x + box.columns, box.y + box.rows}, s.depth[owner],
              first + S::place_of(owner));
    s.box[owner].rows = 0;
  };
  // Sums rows and candidates in one word.
  std::uint32_t own_sums = 0;
#pragma unroll 1
  for (std::uint32_t g = 0; g < kPerThread; ++g) {
    const std::uint32_t owner = kPerThread * threadIdx.x + g, i = first + S::place_of(owner);
    s.box[owner].rows = s.box[owner].columns = 0;
    if ((in_view >> g & 1) == 0 || i >= n) continue;
    const std::uint32_t row = row_of(attributes, a.drawn, gaussian_of<kAnyModel>(v, i));
    const math::Vec3<float> mean = load_mean(attributes.mean, row);
    // Loads geometry before the depth is known: few Gaussians of a chunk in view are out of range, and the loads
    // overlap.
    const Geometry geometry = load_geometry(attributes, row);
    prefetch_color(attributes, row);
    auto p = project<kAnyModel>(v, mean, geometry);
    if (!p.footprint.valid) continue;
    [[maybe_unused]] const math::TileSpan columns = place_copy<kAnyModel, kTurboTile>(v, i, p);
    const float cutoff = math::power_cutoff(p.footprint.opacity);
    const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
    math::TileRect rect = math::bounding_tiles<kTurboTile>(ellipse, v.grid);
    if constexpr (kAnyModel) rect.x0 = math::max(rect.x0, columns.first), rect.x1 = math::min(rect.x1, columns.last);
    if (rect.empty()) continue;
    const auto n_columns = static_cast<std::uint32_t>(rect.x1 - rect.x0),
               n_rows = static_cast<std::uint32_t>(rect.y1 - rect.y0);
    const std::uint32_t depth = turbo_depth(p.z, v.view.near_plane);
    if (n_columns * n_rows > kLargeTiles) {
      set_aside(a.arrays, ellipse, rect, depth, i);
    } else {
      s.ellipse[owner] = ellipse;
      s.depth[owner] = depth;
      s.box[owner] = {static_cast<std::uint16_t>(rect.x0), static_cast<std::uint16_t>(rect.y0), 0,
                      static_cast<std::uint8_t>(n_columns), static_cast<std::uint8_t>(n_rows)};
      own_sums += (n_rows - 1) | (n_columns * n_rows) << 16;
    }
    // Last, since it takes many registers.
    a.splats[i] = screen_splat(p, cutoff, color_of<kAnyModel>(attributes, row, v.view, mean, v.sh_degree));
  }
  const std::uint32_t sums = inclusive_block_sum<kThreads>(own_sums, s.places.warp_sums) - own_sums;
  std::uint32_t begin = sums >> 16, rows = sums & 0xFFFFu;
  std::uint32_t bounds[4] = {};
#pragma unroll
  for (std::uint32_t g = 0; g < kPerThread; ++g) {
    const std::uint32_t owner = kPerThread * threadIdx.x + g;
    const Box box = s.box[owner];
    const std::uint32_t end = begin + std::uint32_t{box.columns} * box.rows;
    rows += box.rows > 0 ? box.rows - 1u : 0;
    s.row_end[owner] = static_cast<std::uint16_t>(rows);
    if (end > begin && end <= kCandidates) {
      s.box[owner].first = static_cast<std::uint16_t>(begin);
      bounds[0] = math::max(bounds[0], kOrigin - box.x), bounds[1] = math::max(bounds[1], kOrigin - box.y);
      bounds[2] = math::max(bounds[2], std::uint32_t{box.x} + box.columns);
      bounds[3] = math::max(bounds[3], std::uint32_t{box.y} + box.rows);
    } else if (end > begin) {
      if (begin <= kCandidates) s.n_candidates = begin;  // the first that does not fit
      leave(owner);
    }
    begin = end;
  }
  if (threadIdx.x == kThreads - 1 && begin <= kCandidates) s.n_candidates = begin;
#pragma unroll
  for (int k = 0; k < 4; ++k) {
    const std::uint32_t most = warp_max(bounds[k]);
    if (threadIdx.x % 32 == 0) atomicMax(s.bounds + k, most);
  }
  __syncthreads();
  const std::uint32_t n_in_block = s.n_candidates;
  if (n_in_block == 0) return;
  const math::TileRect block{static_cast<int>(kOrigin - s.bounds[0]), static_cast<int>(kOrigin - s.bounds[1]),
                             static_cast<int>(s.bounds[2]), static_cast<int>(s.bounds[3])};
  const auto n_tiles = static_cast<std::uint32_t>((block.x1 - block.x0) * (block.y1 - block.y0));
  if (n_tiles > Candidate<kPerThread>::kTiles) {
    for (std::uint32_t g = 0; g < kPerThread; ++g) {
      const std::uint32_t owner = kPerThread * threadIdx.x + g;
      if (s.box[owner].rows > 0) leave(owner);
    }
    return;
  }

  fill_candidates(s, kGaussians + s.row_end[kGaussians - 1], block, [&s](std::uint32_t tile) {
    if (tile < kWindow) atomicAdd(s.counts + tile, 1u);
  });
  __syncthreads();
  for (std::uint32_t window = 0;;) {
    place_window(s, window, block, a.arrays, v.grid);
    for (std::uint32_t k = threadIdx.x; k < n_in_block; k += kThreads) {
      const auto candidate = s.candidates[k];
      const std::uint32_t tile = candidate.tile() - window, owner = candidate.owner();
      if (candidate.cells() == 0 || tile >= kWindow) continue;
      s.listed[owner] = 1;
      const std::uint32_t at = atomicAdd(s.counts + tile, 1u);
      if (at < a.arrays.entry_capacity)
        a.arrays.entries[at] =
            make_entry(s.depth[owner], first + S::place_of(owner), candidate.cells(), turbo_dropped_bits(n));
    }
    window += kWindow;
    if (window >= n_tiles) break;
    __syncthreads();
    clear_counts();
    __syncthreads();
    for (std::uint32_t k = threadIdx.x; k < n_in_block; k += kThreads) {
      const std::uint32_t tile = s.candidates[k].tile() - window;
      if (s.candidates[k].cells() != 0 && tile < kWindow) atomicAdd(s.counts + tile, 1u);
    }
    __syncthreads();
  }
  __syncthreads();
  int visible = 0;
  for (std::uint32_t g = 0; g < kPerThread; ++g)
    visible += __syncthreads_count(s.listed[g * kThreads + threadIdx.x] != 0);
  if (threadIdx.x == 0 && visible > 0) {
    atomic_add(a.arrays.state->counters.visible, static_cast<std::uint64_t>(visible));
  }
}

}  // namespace

Status launch_turbo_emit(const TurboEmitArguments& a, Stream stream) {
  if (a.n == 0) return {};
  const auto n_multiprocessors = multiprocessors();
  if (!n_multiprocessors) return tl::unexpected(n_multiprocessors.error());
  const bool in_pairs = a.in_pairs.value_or(a.n / (2 * kThreads) >= kBlocksOfPairs * *n_multiprocessors);
  const CullPlanes planes = cull_planes(a.view);
  std::visit(
      [&]<class A>(const A& attributes) {
        with_model(a.view.view, [&](auto any_model) {
          const auto launch = [&]<std::uint32_t kPerThread>() {
            turbo_emit_kernel<any_model(), kPerThread>
                <<<blocks_for(a.n, kPerThread * kThreads), kThreads, 0, stream>>>(attributes, planes, a);
          };
          if constexpr (!any_model() && !std::is_same_v<A, PagedAttributes>) {
            if (in_pairs) return launch.template operator()<2>();
          }
          launch.template operator()<1>();
        });
      },
      a.attributes);
  if (const auto ok = launched("the turbo front end could not be launched"); !ok) return ok;
  return launch_turbo_large_gaussians(a.arrays, a.view.grid, stream);
}

}  // namespace rgs::cuda
