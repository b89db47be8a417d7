// front_end.cu - turns attributes into unsorted (tile, Gaussian) pairs in one kernel: a thread a Gaussian, a tile row,
// a pair.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/projection.hpp, coverage.hpp, sh.hpp; the paper, III-A3; tiles after Hanson et al. 2025
// In/Out  attributes -> splats [n] (visible ones), keys and Gaussians [instances]
// Cost    76 B (compact) or 236 B (FP32) read a Gaussian, harmonics only if visible; 48 B written a visible one; 8 or 12 B
//         written a pair, coalesced. About 500 flops a Gaussian, 60 a tile row, 40 integer operations a pair
// Launch  256 threads, ceil(n / 256) blocks
// Shared  Shared: covers, depth keys and the sums that map rows and pairs to their owners; 16 KiB with ellipses
// Order   pairs: by Gaussian, row and column within a block; blocks in the order of their atomic addition, or with
//         block_state in their own. Compiled without contraction to FMA, see project.cu.
//
// A thread that walked its own Gaussian's tiles would make its warp wait for the largest, since coverage ranges from 1
// to all tiles. So the block works on the rows of all its Gaussians side by side, and then on the pairs of 256 rows;
// binary searches in running sums tell each thread its work. Rows are evaluated twice, to count and to emit, which is
// cheaper than storing them.
#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/drawn_rows.cuh"
#include "common/launch.cuh"
#include "common/load_splat.cuh"
#include "common/project_splat.cuh"
#include "sorted/cover.cuh"
#include "sorted/front_end.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;

// A block's word in the chained scan: its state in the upper bits, pairs in the others.
constexpr std::uint64_t kAggregate = std::uint64_t{1} << 62;  // of this block alone
constexpr std::uint64_t kPrefix = std::uint64_t{2} << 62;     // of all blocks up to this one
constexpr std::uint64_t kSumMask = kAggregate - 1;

template <math::Extent E>
struct Shared {
  Cover<E> cover[kThreads];
  std::uint32_t depth[kThreads];
  std::uint32_t row_end[kThreads];   // inclusive sums of the Gaussians' rows
  std::uint32_t pair_end[kThreads];  // inclusive sums of the pairs of 256 rows
  std::uint32_t tile[kThreads];      // first tile of each of these rows
  std::uint8_t row_owner[kThreads];  // and its Gaussian
  std::uint8_t listed[kThreads];     // the Gaussian has a pair
  std::uint32_t warp_sums[2][kWarps];
  std::uint64_t base;  // offset of the block's pairs
  std::uint32_t block;
};

// Row r of the block's Gaussians: owner and tiles.
struct Row {
  std::uint32_t owner;
  std::uint32_t first_tile, n_tiles;
};

template <math::Extent E>
__device__ Row row_at(const Shared<E>& s, std::uint32_t r, math::TileGrid grid) {
  const std::uint32_t owner = owner_of<kThreads>(s.row_end, r);
  const Cover<E>& cover = s.cover[owner];
  const int row = cover.first_row() + static_cast<int>(r - (s.row_end[owner] - cover.n_rows()));
  const auto span = cover.tiles(row, grid);
  return {owner, static_cast<std::uint32_t>(row * grid.columns + span.first),
          static_cast<std::uint32_t>(span.last - span.first)};
}

// Sum over the block in 64 bits, since 256 Gaussians may cover more than 2^32 tiles. Valid in thread 0.
__device__ std::uint64_t block_total(std::uint32_t value, std::uint32_t* warp_sums) {
  // 32 threads of at most 2^24 tiles each (4096 rows of 4096) fit 32 bits.
  const std::uint32_t sum = warp_sum(value);
  if (threadIdx.x % 32 == 0) warp_sums[threadIdx.x / 32] = sum;
  __syncthreads();
  std::uint64_t total = 0;
  if (threadIdx.x == 0) {
    for (int w = 0; w < kWarps; ++w) total += warp_sums[w];
  }
  return total;
}

// Pairs of all blocks before `block`: looks back over their published words, a warp at a time. Warp 0 calls it; `total`
// is the block's own in every lane.
__device__ std::uint64_t chained_base(volatile std::uint64_t* state, std::uint32_t block, std::uint64_t total) {
  const std::uint32_t lane = threadIdx.x;
  if (lane == 0) state[block] = (block == 0 ? kPrefix : kAggregate) | total;
  std::uint64_t base = 0;
  for (std::int64_t last = static_cast<std::int64_t>(block) - 1; last >= 0; last -= 32) {
    const std::int64_t at = last - lane;
    std::uint64_t word = kPrefix;  // nothing precedes the first block
    if (at >= 0) {
      do {
        word = state[at];
      } while (word == 0);
    }
    const std::uint32_t prefixes = __ballot_sync(kFullWarp, (word & kPrefix) != 0);
    const std::uint32_t nearest =
        prefixes == 0 ? 31u : static_cast<std::uint32_t>(__ffs(static_cast<int>(prefixes)) - 1);
    std::uint64_t sum = lane <= nearest ? word & kSumMask : 0;
#pragma unroll
    for (int step = 16; step > 0; step /= 2) sum += __shfl_xor_sync(kFullWarp, sum, step);
    base += sum;
    if (prefixes != 0) break;
  }
  if (lane == 0 && block > 0) state[block] = kPrefix | (base + total);
  return base;
}

struct Output {
  ScreenSplat* splats;
  PairArrays pairs;
  Counters* counters;
  std::uint64_t* block_state;
};

template <math::Extent E>
__device__ void allocate(Shared<E>& s, std::uint64_t total, const Output& out) {
  if (out.block_state == nullptr) {
    if (threadIdx.x == 0) s.base = atomic_add(out.counters->instances, total);
  } else if (threadIdx.x < 32) {
    total = __shfl_sync(kFullWarp, total, 0);
    const std::uint64_t base = chained_base(out.block_state + 1, s.block, total);
    if (threadIdx.x == 0) {
      s.base = base;
      atomic_add(out.counters->instances, total);
    }
  }
}

template <math::Extent E, class Key>
__device__ void emit(Shared<E>& s, std::uint32_t n_rows, std::uint32_t first, const ViewParameters& v,
                     const PairArrays& pairs) {
  Key* const keys = static_cast<Key*>(pairs.keys);
  std::uint64_t base = s.base;
  for (std::uint32_t begin = 0; begin < n_rows; begin += kThreads) {
    const std::uint32_t r = begin + threadIdx.x;
    const Row row = r < n_rows ? row_at(s, r, v.grid) : Row{0, 0, 0};
    s.row_owner[threadIdx.x] = static_cast<std::uint8_t>(row.owner);
    s.tile[threadIdx.x] = row.first_tile;
    s.pair_end[threadIdx.x] = inclusive_block_sum<kThreads>(row.n_tiles, s.warp_sums[0]);
    __syncthreads();
    const std::uint32_t n_pairs = s.pair_end[kThreads - 1];
    for (std::uint32_t k = threadIdx.x; k < n_pairs; k += kThreads) {
      const std::uint32_t at_row = owner_of<kThreads>(s.pair_end, k);
      const std::uint32_t row_begin = at_row == 0 ? 0 : s.pair_end[at_row - 1];
      const std::uint32_t owner = s.row_owner[at_row];
      const std::uint64_t at = base + k;
      if (at < pairs.capacity) {
        keys[at] = make_key<Key>(v, s.tile[at_row] + (k - row_begin), s.depth[owner]);
        pairs.gaussians[at] = first + owner;
      }
    }
    base += n_pairs;
    __syncthreads();
  }
}

template <class A, math::Extent E, class Key, bool kAnyModel>
__global__ void __launch_bounds__(kThreads)
    fused_kernel(A attributes, std::uint32_t n, ViewParameters v, Output out, DrawnChunks drawn) {
  __shared__ Shared<E> s;
  if (threadIdx.x == 0) {
    // Look-back waits for earlier blocks, so they must have started: numbers are drawn, not taken from the grid.
    s.block = out.block_state == nullptr ? blockIdx.x : static_cast<std::uint32_t>(atomic_add(*out.block_state, 1));
  }
  s.listed[threadIdx.x] = 0;
  __syncthreads();
  const std::uint32_t first = s.block * kThreads;
  const std::uint32_t i = first + threadIdx.x;
  std::uint32_t scene_row = 0;

  math::Projected<float> p{};
  math::Vec3<float> mean{};
  float cutoff = 0;
  std::uint32_t rows = 0;
  if (i < n) {
    scene_row = row_of(attributes, drawn, gaussian_of<kAnyModel>(v, i));
    mean = load_mean(attributes.mean, scene_row);
    p = project_splat<kAnyModel>(attributes, scene_row, v, mean);
    if (p.footprint.valid) {
      cutoff = math::power_cutoff(p.footprint.opacity);
      const auto columns = place_copy<kAnyModel, math::kTileSize>(v, i, p);
      const auto cover = Cover<E>::of(p, cutoff, v.grid, columns);
      rows = cover.n_rows();
      s.cover[threadIdx.x] = cover;
      s.depth[threadIdx.x] = depth_key(v, p.z);
    }
  }
  s.row_end[threadIdx.x] = inclusive_block_sum<kThreads>(rows, s.warp_sums[0]);
  __syncthreads();
  const std::uint32_t n_rows = s.row_end[kThreads - 1];
  if (n_rows == 0 && out.block_state == nullptr) return;

  std::uint32_t n_tiles = 0;
  for (std::uint32_t r = threadIdx.x; r < n_rows; r += kThreads) {
    const Row row = row_at(s, r, v.grid);
    if (row.n_tiles > 0) s.listed[row.owner] = 1;
    n_tiles += row.n_tiles;
  }
  allocate(s, block_total(n_tiles, s.warp_sums[1]), out);
  const bool listed = s.listed[threadIdx.x] != 0;
  if (listed)
    out.splats[i] = screen_splat(p, cutoff, color_of<kAnyModel>(attributes, scene_row, v.view, mean, v.sh_degree));
  const int visible = __syncthreads_count(listed);
  if (threadIdx.x == 0 && visible > 0) {
    atomic_add(out.counters->visible, static_cast<std::uint64_t>(visible));
  }
  emit<E, Key>(s, n_rows, first, v, out.pairs);
}

template <class A, math::Extent E>
void run(const A& attributes, const FusedArguments& a, Stream stream) {
  const Output out{a.splats, a.pairs, a.counters, a.block_state};
  const std::uint32_t blocks = fused_blocks(a.n);
  with_model(a.view.view, [&](auto any_model) {
    constexpr bool kAnyModel = any_model();
    const auto kernel = a.pairs.narrow_keys ? fused_kernel<A, E, std::uint32_t, kAnyModel>
                                            : fused_kernel<A, E, std::uint64_t, kAnyModel>;
    kernel<<<blocks, kThreads, 0, stream>>>(attributes, a.n, a.view, out, a.drawn);
  });
}

}  // namespace

std::uint32_t fused_blocks(std::uint32_t n) {
  return blocks_for(n, kThreads);
}

Status launch_fused(const FusedArguments& a, Stream stream) {
  if (a.n == 0) return {};
  std::visit(
      [&](const auto& attributes) {
        using A = std::decay_t<decltype(attributes)>;
        a.extent == math::Extent::square ? run<A, math::Extent::square>(attributes, a, stream)
                                         : run<A, math::Extent::ellipse>(attributes, a, stream);
      },
      a.attributes);
  return launched("the fused front end could not be launched");
}

}  // namespace rgs::cuda
