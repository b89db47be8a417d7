// turbo_order.cu - orders each tile's list by depth and deals it out to the tile's cells.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  lists, entries; units, scratch -> cells [tiles, kTurboCells], cell_gaussians
// Cost    an entry: 8 B read, two atomic additions in shared memory and some comparisons; 4 B written for each touched cell
// Launch  a block a tile, longest lists first, twice: of 256 threads for lists from 1,024 entries on, of 128 for the
//         others; 256 for the units of long lists, as many blocks as the device holds at a time. After ordering each
//         warp deals out to its own cells: one, of 128 threads two (8 cells a tile)
// Shared  Shared: entries, places by bin, bins, places of runs; 31 KiB, of 128 threads 16; 1 KiB of bins for units
// Order   exact: by depth, then by index, whatever the order of the list: deterministic. Of cells in memory: any
//
// Units of a list (turbo_long_lists.cu) are ordered side by side. A unit learns the offsets of its Gaussians in the
// cells from earlier units: they publish their counts before they order, and they have started, because blocks take
// units in turn.
#include <bit>
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "turbo/place_cells.cuh"
#include "turbo/read_list.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr std::uint32_t kPerThread = 8;

// A part of scratch memory, of which a unit orders the entries from <= entry < to.
struct Part {
  const TurboEntry* entries;
  std::uint32_t n;
  TurboEntry from, to;
};

// Of blocks of kThreads.
template <int kThreads>
struct Shared {
  static constexpr int kWarps = kThreads / 32;
  static constexpr std::uint32_t kRound = kPerThread * kThreads;  // capacity
  static constexpr int kBinBits =
      std::bit_width(unsigned{kThreads}) - 1;  // of the histogram that cuts a range, a bin a thread

  TurboEntry entries[kRound];  // in the end ordered
  // To order them: a histogram of (depth, index), of each bin the first place in the low half of the word, the count in
  // the high one; a finer one, whose bins become their first places; the positions by fine bin.
  std::uint32_t bins[kThreads];
  alignas(16) std::uint32_t fine[kRound + 1];
  std::uint16_t placed[kRound];
  TurboRuns::Places<kThreads> places;
  std::uint32_t warp_sums[kWarps];
  std::uint32_t lows[kWarps], highs[kWarps];
  std::uint32_t n;                        // entries to order
  std::uint32_t cell_n[kTurboCells];      // of these entries, or of the unit
  std::uint32_t cell_begin[kTurboCells];  // in cell_gaussians
  std::uint32_t unit;
  Part part;  // of the unit; in registers it would be spilled
  bool fits;
};
constexpr int kUnitThreads = 256;  // of a unit, or of a list of 1,024 entries and more
constexpr int kShortThreads = 128;
using Unit = Shared<kUnitThreads>;
static_assert(Unit::kRound == kTurboRound && kTurboCells <= Unit::kWarps);

// Smallest and largest depth that the block's threads have seen.
struct DepthRange {
  std::uint32_t low = ~0u, high = 0;

  __device__ void add(std::uint32_t depth) { low = math::min(low, depth), high = math::max(high, depth); }
  template <int kThreads>
  __device__ void combine(Shared<kThreads>& s) {
    low = warp_min(low), high = warp_max(high);
    if (threadIdx.x % 32 == 0) s.lows[threadIdx.x / 32] = low, s.highs[threadIdx.x / 32] = high;
    __syncthreads();
#pragma unroll
    for (int w = 0; w < kThreads / 32; ++w) low = math::min(low, s.lows[w]), high = math::max(high, s.highs[w]);
  }
};

// Orders the s.n entries by a bitonic network (Batcher 1968) in shared memory. Rarely called: must not cost the other
// code registers.
template <int kThreads>
__device__ __noinline__ void sort_whole(Shared<kThreads>& s) {
  const std::uint32_t total = 1u << (32 - __clz(static_cast<int>(s.n - 1)));
  for (std::uint32_t k = s.n + threadIdx.x; k < total; k += kThreads) s.entries[k] = ~TurboEntry{0};
  for (std::uint32_t length = 2; length <= total; length *= 2) {
    for (std::uint32_t stride = length / 2; stride > 0; stride /= 2) {
      __syncthreads();
      for (std::uint32_t pair = threadIdx.x; pair < total / 2; pair += kThreads) {
        const std::uint32_t k = 2 * pair - pair % stride;
        const TurboEntry a = s.entries[k], b = s.entries[k + stride];
        if ((a > b) == ((k & length) == 0)) s.entries[k] = b, s.entries[k + stride] = a;
      }
    }
  }
  __syncthreads();
}

// Orders the s.n entries. A histogram over their range of (depth, index) counts them, a bin a thread; if they lay
// evenly within a bin, each would have a certain place. Entries with the same estimate, a fine bin, are compared; if
// they are too many, all entries are sorted. `range` holds the depths that the thread has seen.
template <int kThreads>
__device__ inline void order_entries(Shared<kThreads>& s, DepthRange range, int dropped) {
  constexpr std::uint32_t kMostCompared = 256;  // by one thread, one after the other
  constexpr int kKeyBits = Shared<kThreads>::kBinBits + 16;
  const std::uint32_t n = s.n;
  s.bins[threadIdx.x] = 0;
  static_assert(kPerThread == 8);
  auto* const own_fine = reinterpret_cast<uint4*>(s.fine) + 2 * threadIdx.x;
  own_fine[0] = own_fine[1] = {};
  range.combine(s);
  const int depth_at = kTurboIndexBits + dropped + kTurboCellBits;
  const TurboEntry low = TurboEntry{range.low} << depth_at;
  static_assert(kTurboIndexBits >= kKeyBits);
  const int shift = depth_at + 32 - __clz(static_cast<int>(range.high - range.low)) - kKeyBits;
  // Of the thread's entries: the key, of its bin and its place in the bin; then the fine bin and the place in that; in
  // the end the place among all.
  std::uint32_t key[kPerThread];
#pragma unroll
  for (std::uint32_t j = 0; j < kPerThread; ++j) {
    const std::uint32_t k = j * kThreads + threadIdx.x;
    if (k >= n) break;
    key[j] = static_cast<std::uint32_t>((s.entries[k] - low) >> shift);
    atomicAdd(s.bins + (key[j] >> 16), 1u);
  }
  __syncthreads();
  const std::uint32_t in_bin = s.bins[threadIdx.x];
  const std::uint32_t bin_end = inclusive_block_sum<kThreads>(in_bin, s.warp_sums);
  s.bins[threadIdx.x] = in_bin << 16 | (bin_end - in_bin);
  __syncthreads();
#pragma unroll
  for (std::uint32_t j = 0; j < kPerThread; ++j) {
    if (j * kThreads + threadIdx.x >= n) break;
    const std::uint32_t bin = s.bins[key[j] >> 16];
    const std::uint32_t fine = (bin & 0xFFFF) + ((key[j] & 0xFFFF) * (bin >> 16) >> 16);
    key[j] = fine << 16 | atomicAdd(s.fine + fine, 1u);
  }
  __syncthreads();
  const uint4 first = own_fine[0], last = own_fine[1];
  const std::uint32_t sum = first.x + first.y + first.z + first.w + last.x + last.y + last.z + last.w;
  const auto most_of = [](const uint4& c) { return math::max(math::max(c.x, c.y), math::max(c.z, c.w)); };
  const std::uint32_t most = math::max(most_of(first), most_of(last));
  const std::uint32_t before = inclusive_block_sum<kThreads>(sum, s.warp_sums) - sum;
  const auto begins = [](std::uint32_t x, const uint4& c) -> uint4 {
    return {x, x + c.x, x + c.x + c.y, x + c.x + c.y + c.z};
  };
  own_fine[0] = begins(before, first), own_fine[1] = begins(before + first.x + first.y + first.z + first.w, last);
  if (threadIdx.x == kThreads - 1) s.fine[s.kRound] = n;
  if (__syncthreads_or(most > kMostCompared)) return sort_whole(s);
#pragma unroll
  for (std::uint32_t j = 0; j < kPerThread; ++j) {
    const std::uint32_t k = j * kThreads + threadIdx.x;
    if (k >= n) break;
    s.placed[s.fine[key[j] >> 16] + (key[j] & 0xFFFF)] = static_cast<std::uint16_t>(k);
  }
  __syncthreads();
  TurboEntry own[kPerThread];
#pragma unroll
  for (std::uint32_t j = 0; j < kPerThread; ++j) {
    const std::uint32_t k = j * kThreads + threadIdx.x;
    if (k >= n) break;
    own[j] = s.entries[k];
    const std::uint32_t begin = s.fine[key[j] >> 16], end = s.fine[(key[j] >> 16) + 1];
    key[j] = begin;  // now the place
    if (end - begin > 1) {
#pragma unroll 1  // few
      for (std::uint32_t other = begin; other < end; ++other) key[j] += s.entries[s.placed[other]] < own[j] ? 1 : 0;
    }
  }
  __syncthreads();
#pragma unroll
  for (std::uint32_t j = 0; j < kPerThread; ++j) {
    if (j * kThreads + threadIdx.x >= n) break;
    s.entries[key[j]] = own[j];
  }
  __syncthreads();
}

// Writes the ordered entries to the cells from s.cell_begin on, a warp to its own cells.
template <int kThreads>
__device__ inline void deal_out(const Shared<kThreads>& s, const TurboArrays& a, int dropped) {
  constexpr std::uint32_t kWarps = Shared<kThreads>::kWarps, kOwn = (kTurboCells + kWarps - 1) / kWarps;
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32, below = (1u << lane) - 1;
  // Cells are a power of two: all warps have kOwn, or the first ones one.
  if (kTurboCells % kWarps != 0 && warp + (kOwn - 1) * kWarps >= kTurboCells) return;
  std::uint32_t at[kOwn];
#pragma unroll
  for (std::uint32_t i = 0; i < kOwn; ++i) at[i] = s.cell_begin[warp + i * kWarps];
#pragma unroll 4
  for (std::uint32_t k = lane; k - lane < s.n; k += 32) {
    const TurboEntry entry = k < s.n ? s.entries[k] : 0;
#pragma unroll
    for (std::uint32_t i = 0; i < kOwn; ++i) {
      const bool is_own = touches(entry, warp + i * kWarps);
      const std::uint32_t lanes = __ballot_sync(kFullWarp, is_own);
      if (is_own) {
        a.cell_gaussians[at[i] + static_cast<std::uint32_t>(__popc(static_cast<int>(lanes & below)))] =
            index_of(entry, dropped);
      }
      at[i] += static_cast<std::uint32_t>(__popc(static_cast<int>(lanes)));
    }
  }
}

// Orders a non-empty list that fits shared memory.
template <int kThreads>
__device__ inline void deal_out_short(Shared<kThreads>& s, const TurboArrays& a, math::TileGrid grid,
                                      std::uint32_t rank, const TurboRankedList& list) {
  const int dropped = a.state->dropped;
  if (threadIdx.x == 0) s.n = list.n_entries;
  if (threadIdx.x < kTurboCells) s.cell_n[threadIdx.x] = 0;
  const TurboRuns runs{a.tile_runs + list.begin, a.entries, list.n_runs};
  DepthRange range;
  CellCounter cells(s.cell_n);
  runs.for_each(s.places, [&](TurboEntry entry, std::uint32_t k) {
    s.entries[k] = entry;
    range.add(depth_of(entry, dropped));
    cells.add(entry);
  });
  cells.flush();
  order_entries(s, range, dropped);
  if (threadIdx.x < kTurboCells) {
    const CellPlace place = place_cells(a, grid, rank, list.tile, s.cell_n);
    s.cell_begin[threadIdx.x] = place.begin;
    if (threadIdx.x == 0) s.fits = place.fits;
  }
  __syncthreads();
  if (s.fits) deal_out(s, a, dropped);
}

// Narrows s.part to the unit's share: a sample cuts it into equal ones, the same in all blocks. Entries are unique, so
// equal depths are cut too.
__device__ inline void cut_share(Unit& s, const TurboArrays& a, int dropped) {
  DepthRange range;
  for (std::uint32_t k = threadIdx.x; k < kTurboRound; k += kUnitThreads) {
    s.entries[k] = s.part.entries[std::uint64_t{k} * s.part.n / kTurboRound];
    range.add(depth_of(s.entries[k], dropped));
  }
  if (threadIdx.x == 0) s.n = kTurboRound;
  __syncthreads();
  order_entries(s, range, dropped);
  if (threadIdx.x == 0) {
    const std::uint32_t share = a.units[s.unit].share, n_shares = turbo_shares(s.part.n);
    const auto cut = [&](std::uint32_t k) { return s.entries[k * kTurboRound / n_shares]; };
    if (share > 0) s.part.from = cut(share);
    if (share + 1 < n_shares) s.part.to = cut(share + 1);
  }
  __syncthreads();
}

// Loads the unit's entries into s.entries as far as they fit, their number into s.n, and counts by cell into s.cell_n;
// returns the range of their depths.
__device__ inline DepthRange load(Unit& s, Part part, int dropped) {
  if (threadIdx.x < kTurboCells) s.cell_n[threadIdx.x] = 0;
  if (threadIdx.x == 0) s.n = part.n <= kTurboRound ? part.n : 0;
  __syncthreads();
  DepthRange range;
  CellCounter cells(s.cell_n);
  for (std::uint32_t k = threadIdx.x; k < part.n; k += kUnitThreads) {
    const TurboEntry entry = part.entries[k];
    if (entry < part.from || entry >= part.to) continue;
    const std::uint32_t at = part.n <= kTurboRound ? k : atomicAdd(&s.n, 1u);
    if (at < kTurboRound) s.entries[at] = entry;
    range.add(depth_of(entry, dropped));
    cells.add(entry);
  }
  cells.flush();
  __syncthreads();
  return range;
}

// End of the round that starts at part.from, if the part has more than kTurboRound entries: at most kTurboRound, and at
// least one, lie in part.from <= entry < end. Searches kBins bins of equal width, then the one that holds too many, and
// so on; entries are unique, so bins of width 1 hold one each.
__device__ inline TurboEntry round_end(Unit& s, const Part& part) {
  constexpr TurboEntry kBins = kUnitThreads;
  __shared__ std::uint32_t bins[kBins];
  TurboEntry begin = part.from;
  int shift = math::max(0, 64 - __clzll(static_cast<long long>(part.to - begin)) - Unit::kBinBits);
  for (;;) {
    bins[threadIdx.x] = 0;
    __syncthreads();
    for (std::uint32_t k = threadIdx.x; k < part.n; k += kUnitThreads) {
      const TurboEntry entry = part.entries[k];
      const TurboEntry bin = (entry - begin) >> shift;
      if (entry >= begin && entry < part.to && bin < kBins) atomicAdd(bins + bin, 1u);
    }
    __syncthreads();
    const std::uint32_t end = inclusive_block_sum<kUnitThreads>(bins[threadIdx.x], s.warp_sums);
    const auto fitting = static_cast<TurboEntry>(__syncthreads_count(end <= kTurboRound));
    const bool any = __syncthreads_or(end > 0 && end <= kTurboRound) != 0;
    begin += fitting << shift;
    if (any) return begin;
    shift = shift > Unit::kBinBits ? shift - Unit::kBinBits : 0;
  }
}

// Publishes how many of the unit's entries touch each cell, and sums the counts of the units before it: s.cell_begin.
// Count plus 1 is a single word, 0 until written, so it needs no other synchronisation.
__device__ inline void tell(const Unit& s, const TurboArrays& a) {
  if (threadIdx.x < kTurboCells) {
    static_cast<volatile std::uint32_t*>(a.unit_cells)[kTurboCells * s.unit + threadIdx.x] = s.cell_n[threadIdx.x] + 1;
  }
}
__device__ inline void place_in_cells(Unit& s, const TurboArrays& a) {
  const std::uint32_t unit = s.unit;
  const TurboLongList& list = a.long_lists[a.units[unit].long_list];
  const std::uint32_t cell = threadIdx.x / 32, lane = threadIdx.x % 32;
  if (kTurboCells < Unit::kWarps && cell >= kTurboCells) return;
  const auto told = [&](std::uint32_t k) {
    return *static_cast<const volatile std::uint32_t*>(a.unit_cells + kTurboCells * (list.first_unit + k) + cell);
  };
  // Groups of 32 units, two at a time, starting elsewhere in every unit, so that not all wait for the same words.
  constexpr std::uint32_t kAhead = 2;
  const std::uint32_t n = unit - list.first_unit, n_groups = (n + 31) / 32;
  std::uint32_t before = 0, group = n_groups > 0 ? unit % n_groups : 0;
  for (std::uint32_t begin = 0; begin < n_groups; begin += kAhead) {
    std::uint32_t k[kAhead], seen[kAhead];
#pragma unroll
    for (std::uint32_t j = 0; j < kAhead; ++j) {
      if (begin + j >= n_groups) break;
      k[j] = 32 * group + lane;
      seen[j] = k[j] < n ? told(k[j]) : 1;
      group = group + 1 < n_groups ? group + 1 : 0;
    }
#pragma unroll
    for (std::uint32_t j = 0; j < kAhead; ++j) {
      if (begin + j >= n_groups) break;
      while (seen[j] == 0) seen[j] = told(k[j]);
      before += seen[j] - 1;
    }
  }
  before = warp_sum(before);
  if (lane == 0) s.cell_begin[cell] = list.cell_begin[cell] + before;
}

// Orders unit s.unit: at once, or, if a share is larger than the sample said, as much as fits at a time.
__device__ inline void deal_out_unit(Unit& s, const TurboArrays& a) {
  const int dropped = a.state->dropped;
  if (threadIdx.x == 0) {
    const TurboUnit own = a.units[s.unit];
    s.part = {a.scratch + own.begin, own.end - own.begin, 0, ~TurboEntry{0}};
  }
  __syncthreads();
  if (turbo_shares(s.part.n) > 1) cut_share(s, a, dropped);
  DepthRange range = load(s, s.part, dropped);
  tell(s, a);
  std::uint32_t left = s.n;
  bool is_first = true;
  const bool at_once = left <= kTurboRound;
  while (left > 0) {
    __syncthreads();
    if (!at_once) {
      Part round = s.part;
      if (left > kTurboRound) round.to = round_end(s, round);
      range = load(s, round, dropped);
      if (threadIdx.x == 0) s.part.from = round.to;
    }
    left -= s.n;
    order_entries(s, range, dropped);
    if (is_first) place_in_cells(s, a);  // so late that hardly a unit waits
    is_first = false;
    __syncthreads();
    deal_out(s, a, dropped);
    __syncthreads();
    if (threadIdx.x < kTurboCells) s.cell_begin[threadIdx.x] += s.cell_n[threadIdx.x];
  }
}

__device__ inline void deal_out_units(Unit& s, const TurboArrays& a) {
  for (const std::uint32_t n = a.state->n_units;;) {
    if (threadIdx.x == 0) s.unit = n > 0 ? atomicAdd(&a.state->n_taken, 1u) : 0;
    __syncthreads();
    if (s.unit >= n) return;
    deal_out_unit(s, a);
    __syncthreads();
  }
}

__global__ void __launch_bounds__(kUnitThreads, resident_on_90(4)) turbo_unit_kernel(TurboArrays a) {
  __shared__ Unit s;
  deal_out_units(s, a);
}

// Lists of fewer than 1,024 entries are ordered by short blocks, others below kTurboRound by the rest.
template <int kThreads>
__device__ inline void order_tile(Shared<kThreads>& s, const TurboArrays& a, math::TileGrid grid, std::uint32_t rank,
                                  TurboState* seen) {
  constexpr std::uint32_t kRound = Shared<kThreads>::kRound, kLeast = kThreads == kShortThreads ? 1 : kRound / 2;
  const TurboRankedList list = a.ranked[rank];
  if (list.n_entries < kLeast || list.n_entries >= kRound) return;
  deal_out_short(s, a, grid, rank, list);
  if (threadIdx.x == 0) end_tile(a, seen);
}

template <int kThreads>
__global__ void __launch_bounds__(kThreads, resident_on_90(1280 / kThreads))
    turbo_order_kernel(TurboArrays a, math::TileGrid grid, TurboState* seen) {
  __shared__ Shared<kThreads> s;
  order_tile(s, a, grid, blockIdx.x, seen);
}
template <int kThreads>
__global__ void __launch_bounds__(kThreads)
    turbo_order_sparse_kernel(TurboArrays a, math::TileGrid grid, TurboState* seen) {
  __shared__ Shared<kThreads> s;
  const std::uint32_t end = listed_tiles(a);
  for (std::uint32_t rank = blockIdx.x; rank < end; rank += gridDim.x) {
    order_tile(s, a, grid, rank, seen);
    __syncthreads();
  }
}

template <int kThreads>
Status launch_order(const TurboArrays& a, math::TileGrid grid, TurboState* seen, bool is_sparse, Stream stream) {
  if (is_sparse) {
    turbo_order_sparse_kernel<kThreads><<<sparse_tiles(a.n_tiles), kThreads, 0, stream>>>(a, grid, seen);
  } else {
    turbo_order_kernel<kThreads><<<a.n_tiles, kThreads, 0, stream>>>(a, grid, seen);
  }
  return launched("the kernel that orders the lists could not be launched");
}

}  // namespace

Status launch_turbo_order(const TurboArrays& a, math::TileGrid grid, TurboState* seen, bool is_sparse, Stream stream) {
  static_assert(2 * kShortThreads == kUnitThreads);
  const Status ok = launch_order<kUnitThreads>(a, grid, seen, is_sparse, stream);
  return ok ? launch_order<kShortThreads>(a, grid, seen, is_sparse, stream) : ok;
}

Status launch_turbo_units(const TurboArrays& a, Stream stream) {
  const auto blocks = resident_grid<turbo_unit_kernel>(kUnitThreads);
  if (!blocks) return tl::unexpected(blocks.error());
  turbo_unit_kernel<<<*blocks, kUnitThreads, 0, stream>>>(a);
  return launched("the kernel that orders the long lists could not be launched");
}

}  // namespace rgs::cuda
