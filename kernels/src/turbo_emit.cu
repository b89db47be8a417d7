// turbo_emit.cu - attributes to (tile, Gaussian) pairs of the turbo pipeline, each with its place in the tile's list.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp
// In/Out  attributes [n] -> splats [n], pairs [instances], list_length [tiles]
// Cost    as front_end.cu, with 16 B written a pair and one atomic addition a run of equal tiles in a warp
// Launch  256 threads, ceil(n / 256) blocks
// Shared  Shared: ellipses, depths and the sums that map rows and pairs to their owners; 22 KiB
// Order   of the pairs: as blocks happen to run; the lists' order is made later, by depth and index, so that the image
// is
//         the same on every run. Compiled without contraction to FMA, see project.cu.
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

struct Shared {
  math::Ellipse<float> ellipse[kThreads];
  float depth[kThreads];
  int first_row[kThreads];
  std::uint32_t row_end[kThreads];   // inclusive sums of the Gaussians' rows
  std::uint32_t pair_end[kThreads];  // inclusive sums of the pairs of 256 rows
  std::uint32_t tile[kThreads];      // first tile of each of these rows
  std::uint8_t row_owner[kThreads];  // and its Gaussian
  std::uint8_t listed[kThreads];     // the Gaussian has a pair
  std::uint32_t warp_sums[2][kWarps];
  std::uint64_t base;  // of the block's pairs
};

struct Row {
  std::uint32_t owner;
  std::uint32_t first_tile, n_tiles;
};

__device__ Row row_at(const Shared& s, std::uint32_t r, math::TileGrid grid) {
  const std::uint32_t owner = owner_of<kThreads>(s.row_end, r);
  const std::uint32_t begin = owner == 0 ? 0 : s.row_end[owner - 1];
  const int row = s.first_row[owner] + static_cast<int>(r - begin);
  const auto span = math::tiles_in_row<kTurboTile>(s.ellipse[owner], row, grid);
  return {owner, static_cast<std::uint32_t>(row * grid.columns + span.first),
          static_cast<std::uint32_t>(math::max(span.last - span.first, 0))};
}

// Place in the list of `tile`, for each lane of `lanes`: one addition for all that have the same tile.
__device__ std::uint32_t next_rank(std::uint32_t lanes, std::uint32_t* list_length, std::uint32_t tile) {
  const std::uint32_t same = __match_any_sync(lanes, tile);
  const int leader = __ffs(static_cast<int>(same)) - 1;
  std::uint32_t first = 0;
  const auto lane = threadIdx.x % 32;
  if (lane == static_cast<unsigned>(leader)) {
    first = atomicAdd(list_length + tile, static_cast<std::uint32_t>(__popc(same)));
  }
  first = __shfl_sync(same, first, leader);
  return first + static_cast<std::uint32_t>(__popc(same & ((1u << lane) - 1)));
}

template <class A>
__global__ void __launch_bounds__(kThreads) turbo_emit_kernel(A attributes, TurboEmitArguments a) {
  __shared__ Shared s;
  const ViewParameters& v = a.view;
  const std::uint32_t first = blockIdx.x * kThreads;
  const std::uint32_t i = first + threadIdx.x;
  s.listed[threadIdx.x] = 0;

  math::Projected<float> p{};
  math::Vec3<float> mean{};
  float cutoff = 0;
  std::uint32_t rows = 0;
  if (i < a.n && chunk_in_view(attributes, i, v)) {
    mean = load_mean(attributes.mean, i);
    p = project_splat(attributes, i, v, mean);
    if (p.footprint.valid) {
      cutoff = math::power_cutoff(p.footprint.opacity);
      const auto ellipse = math::ellipse(p.mean, p.footprint, cutoff);
      const auto rect = math::bounding_tiles<kTurboTile>(ellipse, v.grid);
      if (!rect.empty()) {
        rows = static_cast<std::uint32_t>(rect.y1 - rect.y0);
        s.ellipse[threadIdx.x] = ellipse;
        s.first_row[threadIdx.x] = rect.y0;
        s.depth[threadIdx.x] = p.z;
      }
    }
  }
  s.row_end[threadIdx.x] = inclusive_block_sum<kThreads>(rows, s.warp_sums[0]);
  __syncthreads();
  const std::uint32_t n_rows = s.row_end[kThreads - 1];
  if (n_rows == 0) return;

  std::uint32_t n_tiles = 0;
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    const Row row = row_at(s, r, v.grid);
    if (row.n_tiles > 0) s.listed[row.owner] = 1;
    n_tiles += row.n_tiles;
  }
  // 256 Gaussians in at most 2048 x 2048 tiles each: 2^30.
  n_tiles = __reduce_add_sync(kFullWarp, n_tiles);
  if (threadIdx.x % 32 == 0) s.warp_sums[1][threadIdx.x / 32] = n_tiles;
  __syncthreads();
  const bool listed = s.listed[threadIdx.x] != 0;
  if (threadIdx.x == 0) {
    std::uint32_t total = 0;
    for (int w = 0; w < kWarps; ++w) total += s.warp_sums[1][w];
    s.base = atomicAdd(reinterpret_cast<unsigned long long*>(&a.counters->instances),
                       static_cast<unsigned long long>(total));
  }
  if (listed) a.splats[i] = screen_splat(p, cutoff, color_of(attributes, i, v.view, mean, v.sh_degree));
  const int visible = __syncthreads_count(listed);
  if (threadIdx.x == 0 && visible > 0) {
    atomicAdd(reinterpret_cast<unsigned long long*>(&a.counters->visible), static_cast<unsigned long long>(visible));
  }

  std::uint64_t base = s.base;
  for (std::uint32_t begin = 0; begin < n_rows; begin += kThreads) {
    const std::uint32_t r = begin + threadIdx.x;
    const Row row = r < n_rows ? row_at(s, r, v.grid) : Row{0, 0, 0};
    s.row_owner[threadIdx.x] = static_cast<std::uint8_t>(row.owner);
    s.tile[threadIdx.x] = row.first_tile;
    s.pair_end[threadIdx.x] = inclusive_block_sum<kThreads>(row.n_tiles, s.warp_sums[0]);
    __syncthreads();
    const std::uint32_t n_pairs = s.pair_end[kThreads - 1];
    const std::uint32_t lane = threadIdx.x % 32;
    for (std::uint32_t k = threadIdx.x; k - lane < n_pairs; k += kThreads) {
      const std::uint32_t lanes = __ballot_sync(kFullWarp, k < n_pairs);
      if (k >= n_pairs) continue;
      const std::uint32_t at_row = owner_of<kThreads>(s.pair_end, k);
      const std::uint32_t row_begin = at_row == 0 ? 0 : s.pair_end[at_row - 1];
      const std::uint32_t owner = s.row_owner[at_row];
      const std::uint32_t tile = s.tile[at_row] + (k - row_begin);
      const auto columns = static_cast<std::uint32_t>(v.grid.columns);
      const int x = static_cast<int>(tile % columns) * kTurboTile, y = static_cast<int>(tile / columns) * kTurboTile;
      const std::uint64_t cells = math::cells_touched(s.ellipse[owner], x, y);
      const std::uint32_t rank = next_rank(lanes, a.list_length, tile);
      const TurboEntry entry = static_cast<std::uint64_t>(math::depth_bits(s.depth[owner])) << (kTurboIndexBits + 8) |
                               static_cast<std::uint64_t>(first + owner) << 8 | cells;
      if (base + k < a.capacity) a.pairs[base + k] = {entry, tile, rank};
    }
    base += n_pairs;
    __syncthreads();
  }
}

}  // namespace

Status launch_turbo_emit(const TurboEmitArguments& a, Stream stream) {
  if (a.n == 0) return {};
  std::visit(
      [&](const auto& attributes) { emit_kernel<<<blocks_for(a.n, kThreads), kThreads, 0, stream>>>(attributes, a); },
      a.attributes);
  return launched("the turbo front end could not be launched");
}

}  // namespace rgs::cuda
