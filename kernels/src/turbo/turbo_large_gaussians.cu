// turbo_large_gaussians.cu - tiles search the Gaussians that touch many of them; four blocks a region of tiles.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/coverage.hpp, turbo_geometry.hpp
// In/Out  large, large_boxes -> entries, runs
// Cost    8 B read, from L2, a Gaussian and region; if they meet, 64 B gathered, and 8 B written an entry
// Launch  256 threads and four blocks a region of 4x2, 8x4 or 16x8 tiles (of 32, with cells 16 wide): the smallest that
//         makes at most about sixteen blocks a multiprocessor, or the last
// Shared  Shared: the Gaussians found, the cells they touch, a counter a tile; 15 to 24 KiB
// Order   of entries and runs: any. Compiled without contraction to FMA, see project.cu.
//
// The converse, a Gaussian adding to each of its tiles, takes an atomic addition an entry in device memory, and these
// serialise, since large Gaussians touch the same tiles.
#include <bit>
#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "turbo/emit_runs.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kRegionBlocks = 4;  // a region, each with its part of the Gaussians
constexpr std::uint32_t kAhead = 4;         // boxes that a thread reads at a time
constexpr std::uint32_t kBatchRows = 1024;  // rows of Gaussians placed together
constexpr std::uint32_t kMaxBatch = 512;    // Gaussians

// A region: so many strips wide, half as many tiles high.
template <int Strips>
struct Region {
  static constexpr int kColumns = kTurboStripTiles * Strips, kRows = 2 * Strips, kTiles = kColumns * kRows;
  static constexpr std::uint32_t kBatch = kBatchRows / kRows;
  static_assert(kTiles <= kThreads && kBatch <= kMaxBatch && kBatch * kTiles < 1 << 16);
  int x, y;  // first tile

  __device__ bool meets(TurboBox box) const {
    return box.x0 < x + kColumns && box.x1 > x && box.y0 < y + kRows && box.y1 > y;
  }
};

template <int Strips>
struct Shared {
  std::uint32_t found[kMaxBatch + kAhead * kThreads];
  std::uint32_t n_found;
  TurboEntry entry[Region<Strips>::kBatch];  // of the batch's Gaussians, without cells
  std::uint8_t listed[Region<Strips>::kBatch];
  std::uint32_t strips[kBatchRows * Strips];
  std::uint32_t counts[Region<Strips>::kTiles];  // entries of each tile; then the place of its next one
  RunPlaces<kThreads> places;
};

// Of the kAhead * kThreads Gaussians from `first` on that belong to the block, appends those that meet the region:
// kThreads of every kRegionBlocks * kThreads.
template <int Strips>
__device__ void find(Shared<Strips>& s, const TurboArrays& a, Region<Strips> region, std::uint32_t first,
                     std::uint32_t n) {
  TurboBox box[kAhead];
#pragma unroll
  for (std::uint32_t j = 0; j < kAhead; ++j) {
    const std::uint32_t k = first + j * kRegionBlocks * kThreads;
    box[j] = k < n ? a.large_boxes[k] : TurboBox{0, 0, 0, 0};
  }
#pragma unroll
  for (std::uint32_t j = 0; j < kAhead; ++j) {
    if (region.meets(box[j])) s.found[atomicAdd(&s.n_found, 1u)] = first + j * kRegionBlocks * kThreads;
  }
}

// Cells of a strip within the columns of a box.
__device__ std::uint32_t cells_within(std::uint32_t strip, int column, TurboBox box) {
  const int low = math::clamp(kTurboCellColumns * (box.x0 - column), 0, kTurboStripCells);
  const int high = math::clamp(kTurboCellColumns * (box.x1 - column), low, kTurboStripCells);
  return strip & ((1u << high) - (1u << low)) * kTurboStripRows;
}

// Writes entries and runs of the found Gaussians begin .. begin + n - 1; n <= kBatch. Returns how many of the thread's
// get their first entry.
template <int Strips>
__device__ std::uint32_t place(Shared<Strips>& s, const TurboArrays& a, Region<Strips> region, math::TileGrid grid,
                               std::uint32_t begin, std::uint32_t n) {
  using R = Region<Strips>;
  for (std::uint32_t t = threadIdx.x; t < R::kTiles; t += kThreads) s.counts[t] = 0;
  for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) s.listed[k] = 0;
  __syncthreads();
  for (std::uint32_t item = threadIdx.x; item < n * R::kRows; item += kThreads) {
    const std::uint32_t k = item / R::kRows, row = item % R::kRows;
    const std::uint32_t at = s.found[begin + k];
    const TurboBox box = a.large_boxes[at];
    const TurboLargeGaussian& large = a.large_gaussians[at];
    if (row == 0) s.entry[k] = make_entry(large.depth, large.index, 0, a.state->dropped);
    const int y = region.y + static_cast<int>(row);
    const bool inside = y >= box.y0 && y < box.y1;
    const auto rows = cell_rows(large.ellipse, y);
#pragma unroll
    for (int across = 0; across < Strips; ++across) {
      const int column = region.x + kTurboStripTiles * across;
      const std::uint32_t strip = inside ? cells_within(cells_of_strip(rows, column), column, box) : 0;
      s.strips[item * Strips + static_cast<std::uint32_t>(across)] = strip;
#pragma unroll
      for (int j = 0; j < kTurboStripTiles; ++j) {
        if (cells_in_strip(strip, j) != 0) {
          atomicAdd(s.counts + row * R::kColumns + static_cast<std::uint32_t>(kTurboStripTiles * across + j), 1u);
        }
      }
    }
  }
  __syncthreads();
  const int tile = static_cast<int>(threadIdx.x);
  const std::uint32_t n_entries = tile < R::kTiles ? s.counts[tile] : 0;
  const int row = region.y + tile / R::kColumns, column = region.x + tile % R::kColumns;
  const std::uint32_t first =
      reserve_runs(s.places, n_entries, static_cast<std::uint32_t>(row * grid.columns + column), a);
  if (tile < R::kTiles) s.counts[tile] = first;
  __syncthreads();
  for (std::uint32_t k = threadIdx.x; k < n * R::kRows * Strips; k += kThreads) {
    const std::uint32_t strip = s.strips[k];
    if (strip == 0) continue;
    const std::uint32_t owner = k / (R::kRows * Strips);
    s.listed[owner] = 1;
    std::uint32_t* const next = s.counts + k % (R::kRows * Strips) * kTurboStripTiles;
#pragma unroll
    for (int j = 0; j < kTurboStripTiles; ++j) {
      const std::uint32_t cells = cells_in_strip(strip, j);
      if (cells == 0) continue;
      const std::uint32_t at = atomicAdd(next + j, 1u);
      if (at < a.entry_capacity) a.entries[at] = s.entry[owner] | cells;
    }
  }
  __syncthreads();
  std::uint32_t visible = 0;
  for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) {
    std::uint32_t& listed = a.large_gaussians[s.found[begin + k]].listed;
    if (s.listed[k] != 0 && listed == 0 && atomicExch(&listed, 1u) == 0) ++visible;
  }
  return visible;
}

template <int Strips>
__global__ void __launch_bounds__(kThreads) turbo_large_gaussians_kernel(TurboArrays a, math::TileGrid grid) {
  using R = Region<Strips>;
  __shared__ Shared<Strips> memory;
  Shared<Strips>& s = memory;
  const R region{static_cast<int>(blockIdx.x) * R::kColumns, static_cast<int>(blockIdx.y) * R::kRows};
  const auto n = static_cast<std::uint32_t>(math::min(std::uint64_t{a.state->n_large_gaussians}, a.large_capacity));
  std::uint32_t visible = 0;
  if (threadIdx.x == 0) s.n_found = 0;
  __syncthreads();
  constexpr std::uint32_t kStep = kAhead * kRegionBlocks * kThreads;
  for (std::uint32_t first = blockIdx.z * kThreads; first < n; first += kStep) {
    find(s, a, region, first + threadIdx.x, n);
    __syncthreads();
    const bool last = first + kStep >= n;
    const std::uint32_t n_before = s.n_found;
    std::uint32_t n_found = n_before;
    while (n_found >= R::kBatch || (last && n_found > 0)) {
      const std::uint32_t batch = math::min(n_found, R::kBatch);
      n_found -= batch;
      visible += place(s, a, region, grid, n_found, batch);
      __syncthreads();
    }
    // After place(), whose barriers ensure that all threads have read it.
    if (threadIdx.x == 0 && n_found != n_before) s.n_found = n_found;
    __syncthreads();
  }
  visible = warp_sum(visible);
  if (threadIdx.x % 32 == 0 && visible > 0) atomic_add(a.state->counters.visible, visible);
}

template <int Strips>
void launch(const TurboArrays& a, math::TileGrid grid, Stream stream) {
  using R = Region<Strips>;
  const auto tiles = [](int n, int of_region) { return static_cast<unsigned>((n + of_region - 1) / of_region); };
  const dim3 blocks{tiles(grid.columns, R::kColumns), tiles(grid.rows, R::kRows), kRegionBlocks};
  turbo_large_gaussians_kernel<Strips><<<blocks, kThreads, 0, stream>>>(a, grid);
}

}  // namespace

Status launch_turbo_large_gaussians(const TurboArrays& a, math::TileGrid grid, Stream stream) {
  const auto n_multiprocessors = multiprocessors();
  if (!n_multiprocessors) return tl::unexpected(n_multiprocessors.error());
  // Regions grow when there would be more than four of them, sixteen blocks, a multiprocessor.
  const std::uint32_t most_tiles = std::bit_floor(4 * *n_multiprocessors) * Region<1>::kTiles;
  if (a.n_tiles <= most_tiles) {
    launch<1>(a, grid, stream);
  } else if (a.n_tiles <= 4 * most_tiles) {
    launch<2>(a, grid, stream);
  } else {
    launch<4>(a, grid, stream);
  }
  return launched("the kernel of large Gaussians could not be launched");
}

}  // namespace rgs::cuda
