// turbo_order.cu - orders each tile's list by depth and deals it out to the tile's cells.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  lists, entries -> cells [tiles, 8], cell_gaussians
// Cost    an entry: 8 B read, 3 or 4 instructions a step of the sorting network; 4 B written for each cell it touches
// Launch  256 threads a tile, longest lists first. A warp orders 128 or 256 entries in registers, the block merges them;
//         then a warp deals out 32 at a time
// Shared  Shared: entries, their keys twice, histograms; 41 KiB
// Order   exact: by depth, then by index, whatever the order of the list: deterministic. Of cells in memory: any
//
// Lists are as long as the scene makes them, shared memory is not: a list longer than kTurboEntries is first moved to
// scratch memory in the order of 1,024 bins of depth, and then taken in rounds of as many bins as fit. A bin that does not
// fit is cut in finer ones, and so on.
#include <cstdint>

#include "atomic_add.cuh"
#include "block_scan.cuh"
#include "launch.cuh"
#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr std::uint32_t kEntries = kTurboEntries;
constexpr int kBinBits = 8;       // of the histogram that cuts a range, a bin a thread
constexpr int kDepthBins = 1024;  // of the histogram that cuts a long list, by depth
static_assert(kEntries == 8 * kThreads && kThreads == 1 << kBinBits && kWarps == kTurboCells);
constexpr int kBinsPerThread = kDepthBins / kThreads;

struct Shared {
  TurboEntry entries[kEntries];
  alignas(16) std::uint32_t exchange[2][kEntries];  // keys: depth above, position among the entries below
  std::uint32_t* order;                             // the one of the two that is in order
  std::uint32_t positions;                          // mask of a key's position
  std::uint32_t bins[kDepthBins];
  std::uint32_t run_begin[kThreads], run_end[kThreads];  // of 256 runs: first entry, inclusive sums of their sizes
  std::uint32_t warp_sums[kWarps];
  std::uint32_t n;                        // entries of the round
  std::uint32_t cell_n[kTurboCells];      // of the whole list
  std::uint32_t cell_begin[kTurboCells];  // in cell_gaussians
  std::uint32_t chunks[kTurboCells]
                      [kEntries / 32];  // of each 32 entries, how many touch a cell; then sums of those before
  TurboList head;
  std::uint32_t tile;
  bool fits;
};

__device__ inline std::uint32_t depth_of(TurboEntry entry) {
  return static_cast<std::uint32_t>(entry >> (kTurboIndexBits + 8));
}

template <std::uint32_t kKeys>
__device__ inline void store_keys(const std::uint32_t (&keys)[kKeys], std::uint32_t* to) {
#pragma unroll
  for (std::uint32_t k = 0; k < kKeys; k += 4) {
    *reinterpret_cast<uint4*>(to + k) = {keys[k], keys[k + 1], keys[k + 2], keys[k + 3]};
  }
}

// Orders the keys of a warp's lanes; in the end element k of lane l is number kKeys l + k. A bitonic network (Batcher
// 1968): its short strides are between elements of one lane, its long ones between lanes. Where a run is to descend,
// keys are inverted for its time, so that every comparison is an ascending one.
template <std::uint32_t kKeys>
__device__ inline void sort_warp(std::uint32_t (&key)[kKeys]) {
  const std::uint32_t lane = threadIdx.x % 32;
  std::uint32_t inverted = 0;  // all ones where keys are
#pragma unroll
  for (std::uint32_t run = 2; run <= 32 * kKeys; run *= 2) {
    if (run >= kKeys) {
      const std::uint32_t invert = (lane & (run / kKeys)) != 0 && run < 32 * kKeys ? ~0u : 0;
#pragma unroll
      for (std::uint32_t& k : key) k ^= inverted ^ invert;
      inverted = invert;
    }
#pragma unroll
    for (std::uint32_t stride = run / 2; stride > 0; stride /= 2) {
      if (stride >= kKeys) {
        const bool smaller = (lane & (stride / kKeys)) == 0;
#pragma unroll
        for (std::uint32_t& k : key) {
          const std::uint32_t other = __shfl_xor_sync(kFullWarp, k, stride / kKeys);
          k = smaller ? math::min(k, other) : math::max(k, other);
        }
      } else {
#pragma unroll
        for (std::uint32_t k = 0; k < kKeys; ++k) {
          if ((k & stride) != 0) continue;
          const std::uint32_t low = math::min(key[k], key[k + stride]), high = math::max(key[k], key[k + stride]);
          const bool ascending = run >= kKeys || (k & run) == 0;
          key[k] = ascending ? low : high;
          key[k + stride] = ascending ? high : low;
        }
      }
    }
  }
}

// Merges neighbouring runs of `run` ordered keys, of `total` in all; a thread has kKeys places of the result and looks
// for where they begin in both (Odeh, Green, Mwassi, Shmueli, Birk 2012).
template <std::uint32_t kKeys>
__device__ inline void merge_runs(const std::uint32_t* from, std::uint32_t* to, std::uint32_t run,
                                  std::uint32_t total) {
  const std::uint32_t first = kKeys * threadIdx.x;
  if (first >= total) return;
  const std::uint32_t base = first & ~(2 * run - 1), place = first - base;
  const std::uint32_t* const a = from + base;
  const std::uint32_t* const b = a + run;
  std::uint32_t low = place > run ? place - run : 0, high = math::min(place, run);
  while (low < high) {
    const std::uint32_t middle = (low + high) / 2;
    if (a[middle] < b[place - 1 - middle]) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  std::uint32_t i = low, j = place - low;
  std::uint32_t next_a = i < run ? a[i] : ~0u, next_b = j < run ? b[j] : ~0u;
  std::uint32_t merged[kKeys];
#pragma unroll
  for (std::uint32_t& k : merged) {
    const bool is_a = next_a <= next_b;
    k = is_a ? next_a : next_b;
    if (is_a) {
      ++i;
      next_a = i < run ? a[i] : ~0u;
    } else {
      ++j;
      next_b = j < run ? b[j] : ~0u;
    }
  }
  store_keys(merged, to + first);
}

// The block's smallest and largest of the depths that its threads have seen.
struct DepthRange {
  std::uint32_t low = ~0u, high = 0;

  __device__ void add(std::uint32_t depth) { low = math::min(low, depth), high = math::max(high, depth); }
  __device__ void share(Shared& s) {
    low = reduce_warp(low, [](std::uint32_t a, std::uint32_t b) { return math::min(a, b); });
    high = reduce_warp(high, [](std::uint32_t a, std::uint32_t b) { return math::max(a, b); });
    if (threadIdx.x % 32 == 0) s.run_begin[threadIdx.x / 32] = low, s.run_end[threadIdx.x / 32] = high;
    __syncthreads();
#pragma unroll
    for (int w = 0; w < kWarps; ++w) low = math::min(low, s.run_begin[w]), high = math::max(high, s.run_end[w]);
  }
};

// Orders the keys of the round's entries, depth above and position below: kKeys a lane by warps, then merged. Where they
// are then.
template <std::uint32_t kKeys>
__device__ inline std::uint32_t* sort_keys(Shared& s, std::uint32_t nearest, int shift, int position_bits) {
  constexpr std::uint32_t kRun = 32 * kKeys;
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const std::uint32_t total = s.n <= kRun ? kRun : kRun << (32 - __clz(static_cast<int>((s.n - 1) / kRun)));
  if (kRun * warp < total) {
    std::uint32_t key[kKeys];
#pragma unroll
    for (std::uint32_t k = 0; k < kKeys; ++k) {
      const std::uint32_t position = kRun * warp + 32 * k + lane;
      key[k] = position < s.n ? (depth_of(s.entries[position]) - nearest) >> shift << position_bits | position : ~0u;
    }
    if (kRun * warp < s.n) sort_warp(key);
    store_keys(key, s.exchange[0] + kRun * warp + kKeys * lane);
  }
  __syncthreads();
  int at = 0;
  for (std::uint32_t run = kRun; run < total; run *= 2, at ^= 1) {
    merge_runs<kKeys>(s.exchange[at], s.exchange[at ^ 1], run, total);
    __syncthreads();
  }
  return s.exchange[at];
}

// Position of each of the s.n entries in the order of the entries, into s.order. Keys of 32 bits are ordered first. Their
// depth is relative to the list's own range and may have lost its last bits: neighbours of equal depth are then put right
// by looking at the entries themselves. `range` is that of the depths that the thread has seen.
__device__ inline void sort_entries(Shared& s, DepthRange range) {
  range.share(s);
  // Padding, all ones, comes last: it shares its depth with no position as high.
  const int position_bits = 32 - __clz(static_cast<int>(s.n - 1));
  const std::uint32_t positions = (1u << position_bits) - 1;
  s.positions = positions;  // the same from all threads
  const int shift = math::max(0, 32 - __clz(static_cast<int>(range.high - range.low + 1)) - (32 - position_bits));
  // Short lists are spread over more warps: all wait for the last.
  std::uint32_t* const order = s.n <= 4 * kThreads ? sort_keys<4>(s, range.low, shift, position_bits)
                                                   : sort_keys<8>(s, range.low, shift, position_bits);
  s.order = order;
  const auto is_inverted = [&](std::uint32_t k) {
    const std::uint32_t a = order[k], b = order[k + 1];
    return ((a ^ b) & ~positions) == 0 && s.entries[a & positions] > s.entries[b & positions];
  };
  bool any = false;
  for (std::uint32_t k = threadIdx.x; k + 1 < s.n; k += kThreads) any = any || is_inverted(k);
  if (!__syncthreads_or(any)) return;
  for (std::uint32_t odd = 0, quiet = 0; quiet < 2; odd ^= 1) {
    bool swapped = false;
    for (std::uint32_t k = 2 * threadIdx.x + odd; k + 1 < s.n; k += 2 * kThreads) {
      if (!is_inverted(k)) continue;
      const std::uint32_t a = order[k];
      order[k] = order[k + 1], order[k + 1] = a;
      swapped = true;
    }
    quiet = __syncthreads_or(swapped) ? 0 : quiet + 1;
  }
}

// A tile's entries: runs of them.
struct List {
  const TurboRun* runs;
  const TurboEntry* entries;
  std::uint32_t n_runs;

  // Calls f(entry, position in the list) for every entry. All threads of the block call it. Four loads of a thread are
  // on their way at a time.
  template <class F>
  __device__ void for_each(Shared& s, const F& f) const {
    constexpr int kAhead = 4;
    std::uint32_t done = 0;
    for (std::uint32_t begin = 0; begin < n_runs; begin += kThreads) {
      const TurboRun run = begin + threadIdx.x < n_runs ? runs[begin + threadIdx.x] : TurboRun{0, 0};
      s.run_end[threadIdx.x] = inclusive_block_sum<kThreads>(run.n, s.warp_sums);
      s.run_begin[threadIdx.x] = run.begin;
      __syncthreads();
      const std::uint32_t n = s.run_end[kThreads - 1];
      for (std::uint32_t first = threadIdx.x; first < n; first += kAhead * kThreads) {
        TurboEntry loaded[kAhead];
#pragma unroll
        for (int j = 0; j < kAhead; ++j) {
          const std::uint32_t k = first + static_cast<std::uint32_t>(j * kThreads);
          if (k >= n) break;
          const std::uint32_t owner = owner_of<kThreads>(s.run_end, k);
          const std::uint32_t before = owner == 0 ? 0 : s.run_end[owner - 1];
          loaded[j] = entries[s.run_begin[owner] + (k - before)];
        }
#pragma unroll
        for (int j = 0; j < kAhead; ++j) {
          const std::uint32_t k = first + static_cast<std::uint32_t>(j * kThreads);
          if (k < n) f(loaded[j], done + k);
        }
      }
      done += n;
      __syncthreads();
    }
  }
};

// Bins of a list's depths: of equal width in their bits, which is nearly equal ratio, from the nearest to the farthest.
struct DepthBins {
  std::uint32_t nearest;
  int shift;
  __device__ std::uint32_t of(TurboEntry entry) const { return (depth_of(entry) - nearest) >> shift; }
};

__device__ inline DepthBins depth_bins(Shared& s, const List& list) {
  DepthRange range;
  list.for_each(s, [&](TurboEntry entry, std::uint32_t) { range.add(depth_of(entry)); });
  range.share(s);
  __syncthreads();
  constexpr int kBits = 10;
  static_assert(kDepthBins == 1 << kBits);
  return {range.low, math::max(0, 32 - __clz(static_cast<int>(range.high - range.low)) - kBits)};
}

// Adds up, over the block, how many entries of a list touch each cell. An entry's eight bits go to eight counters of 16
// bits in two words, which are passed on before one can overflow.
class CellCounter {
 public:
  __device__ void add(Shared& s, TurboEntry entry) {
    constexpr std::uint64_t kSpread = 1 | 1u << 15 | 1u << 30 | std::uint64_t{1} << 45;
    constexpr std::uint64_t kLowest = 0x0001000100010001;
    low_ += (entry & 0xF) * kSpread & kLowest;
    high_ += (entry >> 4 & 0xF) * kSpread & kLowest;
    if (++n_ < 0xFFFF) return;
    for (int c = 0; c < kTurboCells; ++c) atomicAdd(s.cell_n + c, of(c));
    low_ = high_ = 0, n_ = 0;
  }
  // All lanes of a warp call it, in the end.
  __device__ void flush(Shared& s) const {
    for (int c = 0; c < kTurboCells; ++c) {
      const std::uint32_t sum = warp_sum(of(c));
      if (threadIdx.x % 32 == 0) atomicAdd(s.cell_n + c, sum);
    }
  }

 private:
  __device__ std::uint32_t of(int cell) const {
    return static_cast<std::uint32_t>((cell < 4 ? low_ : high_) >> (16 * (cell % 4))) & 0xFFFF;
  }

  std::uint64_t low_ = 0, high_ = 0;
  std::uint32_t n_ = 0;
};

// Moves a list to `sorted` in the order of its bins; s.bins then holds the end of each, s.cell_n how many entries touch
// each cell.
__device__ inline void order_by_bins(Shared& s, const List& list, TurboEntry* sorted) {
  const DepthBins bins = depth_bins(s, list);
  for (int k = 0; k < kBinsPerThread; ++k) s.bins[kThreads * k + threadIdx.x] = 0;
  __syncthreads();
  CellCounter counter;
  list.for_each(s, [&](TurboEntry entry, std::uint32_t) {
    atomicAdd(s.bins + bins.of(entry), 1u);
    counter.add(s, entry);
  });
  counter.flush(s);
  std::uint32_t sum = 0;
  for (int k = 0; k < kBinsPerThread; ++k) sum += s.bins[kBinsPerThread * threadIdx.x + k];
  std::uint32_t at = inclusive_block_sum<kThreads>(sum, s.warp_sums) - sum;
  for (int k = 0; k < kBinsPerThread; ++k) {
    std::uint32_t& bin = s.bins[kBinsPerThread * threadIdx.x + k];
    const std::uint32_t n = bin;
    bin = at;
    at += n;
  }
  __syncthreads();
  list.for_each(s, [&](TurboEntry entry, std::uint32_t) { sorted[atomicAdd(s.bins + bins.of(entry), 1u)] = entry; });
}

// End of the largest number of whole bins from position `begin` on that hold at most kEntries entries, and at least
// one; or, if the next bin holds more, its end, to be cut further.
__device__ inline std::uint32_t group_end(const Shared& s, std::uint32_t begin) {
  std::uint32_t fitting = begin, next = ~0u;  // ends of bins: the last that fits, the first that does not
  for (int k = 0; k < kBinsPerThread; ++k) {
    const std::uint32_t end = s.bins[kBinsPerThread * threadIdx.x + k];
    if (end <= begin) continue;
    if (end - begin <= kEntries) {
      fitting = math::max(fitting, end);
    } else {
      next = math::min(next, end);
    }
  }
  __shared__ std::uint32_t ends[2];
  if (threadIdx.x == 0) ends[0] = begin, ends[1] = ~0u;
  __syncthreads();
  fitting = reduce_warp(fitting, [](std::uint32_t a, std::uint32_t b) { return math::max(a, b); });
  next = reduce_warp(next, [](std::uint32_t a, std::uint32_t b) { return math::min(a, b); });
  if (threadIdx.x % 32 == 0) {
    atomicMax(ends, fitting);
    atomicMin(ends + 1, next);
  }
  __syncthreads();
  const std::uint32_t end = ends[0] > begin ? ends[0] : ends[1];
  __syncthreads();
  return end;
}

// End of the round that begins at `begin`, from where more than kEntries of the n entries are left: at most kEntries of
// them, and at least one, lie in begin <= entry < end. Looks for it among kBins bins of equal width, then in the one
// that holds too many, and so on: entries are unique, so that bins of width 1 hold one each.
__device__ inline TurboEntry round_end(Shared& s, const TurboEntry* entries, std::uint32_t n, TurboEntry begin) {
  constexpr TurboEntry kBins = TurboEntry{1} << kBinBits;
  __shared__ std::uint32_t bins[kBins];
  int shift = 64 - kBinBits;
  for (;;) {
    bins[threadIdx.x] = 0;
    __syncthreads();
    for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) {
      const TurboEntry entry = entries[k];
      const TurboEntry bin = (entry - begin) >> shift;
      if (entry >= begin && bin < kBins) atomicAdd(bins + bin, 1u);
    }
    __syncthreads();
    const std::uint32_t end = inclusive_block_sum<kThreads>(bins[threadIdx.x], s.warp_sums);
    const auto fitting = static_cast<TurboEntry>(__syncthreads_count(end <= kEntries));
    const bool any = __syncthreads_or(end > 0 && end <= kEntries) != 0;
    begin += fitting << shift;
    if (any) return begin;
    shift = shift > kBinBits ? shift - kBinBits : 0;
  }
}

// The cells of 32 entries in order, from position `begin` on; 0 past the last.
__device__ inline TurboEntry ordered_entry(const Shared& s, std::uint32_t begin) {
  const std::uint32_t k = begin + threadIdx.x % 32;
  return k < s.n ? s.entries[s.order[k] & s.positions] : 0;
}

// How many of each 32 ordered entries touch each cell: a warp counts 32 of them, then sums up a cell. s.cell_n becomes the
// sums over the round.
__device__ inline void count_chunks(Shared& s) {
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  for (std::uint32_t chunk = warp; 32 * chunk < s.n; chunk += kWarps) {
    const auto cells = static_cast<std::uint32_t>(ordered_entry(s, 32 * chunk));
    std::uint32_t own = 0;
#pragma unroll
    for (std::uint32_t c = 0; c < kTurboCells; ++c) {
      const std::uint32_t lanes = __ballot_sync(kFullWarp, (cells >> c & 1) != 0);
      if (lane == c) own = lanes;
    }
    if (lane < kTurboCells) s.chunks[lane][chunk] = static_cast<std::uint32_t>(__popc(static_cast<int>(own)));
  }
  __syncthreads();
  const std::uint32_t n_chunks = (s.n + 31) / 32;
  for (std::uint32_t c = warp; c < kTurboCells; c += kWarps) {
    std::uint32_t sum = 0;
    for (std::uint32_t begin = 0; begin < n_chunks; begin += 32) {
      const std::uint32_t n = begin + lane < n_chunks ? s.chunks[c][begin + lane] : 0;
      const std::uint32_t end = inclusive_warp_sum(n);
      s.chunks[c][begin + lane] = sum + end - n;
      sum += __shfl_sync(kFullWarp, end, 31);
    }
    if (lane == 0) s.cell_n[c] = sum;
  }
  __syncthreads();
}

// Places for the cells' Gaussians, and their heads; the cells of a tile lie at its rank.
__device__ inline void reserve_cells(Shared& s, const TurboArrays& a, math::TileGrid grid, std::uint32_t rank) {
  const std::uint32_t own = threadIdx.x;
  if (own < kTurboCells) {
    std::uint32_t before = 0, total = 0;
    for (std::uint32_t c = 0; c < kTurboCells; ++c) {
      if (c < own) before += s.cell_n[c];
      total += s.cell_n[c];
    }
    std::uint64_t base = 0;
    if (own == 0 && total > 0) base = atomic_add(a.state->in_cells, total);
    base = __shfl_sync((1u << kTurboCells) - 1, base, 0);
    const bool fits = base + total <= a.cell_capacity;
    const auto begin = static_cast<std::uint32_t>(base) + before;
    s.cell_begin[own] = begin;
    if (own == 0) s.fits = fits;
    const auto columns = static_cast<std::uint32_t>(grid.columns);
    a.cells[kTurboCells * rank + own] = {begin, fits ? s.cell_n[own] : 0,
                                         s.tile % columns * kTurboTile + math::kCellWidth * (own % 2),
                                         s.tile / columns * kTurboTile + math::kCellHeight * (own / 2)};
  }
  __syncthreads();
}

// Writes the round's ordered entries to the cells from s.cell_begin on.
__device__ inline void deal_out(const Shared& s, const TurboArrays& a) {
  const std::uint32_t lane = threadIdx.x % 32, below = (1u << lane) - 1;
  for (std::uint32_t chunk = threadIdx.x / 32; 32 * chunk < s.n; chunk += kWarps) {
    const TurboEntry entry = ordered_entry(s, 32 * chunk);
    const auto cells = static_cast<std::uint32_t>(entry);
    const auto gaussian = static_cast<std::uint32_t>(entry >> 8) & static_cast<std::uint32_t>(kMaxTurboGaussians - 1);
    const std::uint32_t own = lane % kTurboCells;
    const std::uint32_t begin = s.cell_begin[own] + s.chunks[own][chunk];  // of cell `own`
#pragma unroll
    for (std::uint32_t c = 0; c < kTurboCells; ++c) {
      const bool touches = (cells >> c & 1) != 0;
      const std::uint32_t lanes = __ballot_sync(kFullWarp, touches);
      const std::uint32_t at = __shfl_sync(kFullWarp, begin, static_cast<int>(c));
      if (touches)
        a.cell_gaussians[at + static_cast<std::uint32_t>(__popc(static_cast<int>(lanes & below)))] = gaussian;
    }
  }
}

// The tile of a rank: the longest lists come first. A warp calls it.
__device__ std::uint32_t tile_of_rank(const TurboArrays& a, std::uint32_t rank) {
  const std::uint32_t lane = threadIdx.x % 32;
  const std::uint32_t size = a.state->class_size[lane];
  const std::uint32_t end = inclusive_warp_sum(size);
  const int length = __ffs(static_cast<int>(__ballot_sync(kFullWarp, end > rank))) - 1;
  const std::uint32_t begin = __shfl_sync(kFullWarp, end - size, length);
  return a.classes[static_cast<std::uint32_t>(length) * a.n_tiles + rank - begin];
}
static_assert(kTurboClasses == 32, "a lane a class");

// All threads call it.
__device__ inline void begin_tile(Shared& s, const TurboArrays& a, std::uint32_t rank) {
  if (threadIdx.x < 32) {
    const std::uint32_t tile = tile_of_rank(a, rank);
    if (threadIdx.x == 0) {
      s.tile = tile;
      s.head = a.lists[tile];
      s.n = s.head.n_entries;
    }
  }
  if (threadIdx.x < kTurboCells) s.cell_n[threadIdx.x] = 0;
  __syncthreads();
}

// The last tile tells the host.
__device__ inline void end_tile(const TurboArrays& a, TurboState* seen) {
  if (threadIdx.x != 0) return;
  __threadfence();
  if (atomicAdd(&a.state->ordered, 1u) == a.n_tiles - 1) {
    seen->in_cells = *static_cast<volatile std::uint64_t*>(&a.state->in_cells);
    __threadfence_system();
  }
}

// A list that fits shared memory.
__device__ inline void deal_out_short(Shared& s, const TurboArrays& a, math::TileGrid grid, std::uint32_t rank) {
  const List list{a.tile_runs + s.head.begin, a.entries, s.head.n_runs};
  DepthRange range;
  list.for_each(s, [&](TurboEntry entry, std::uint32_t k) {
    s.entries[k] = entry;
    range.add(depth_of(entry));
  });
  if (s.n > 0) sort_entries(s, range);
  count_chunks(s);
  reserve_cells(s, a, grid, rank);
  if (s.fits) deal_out(s, a);
}

// A list of any length, in rounds.
__device__ inline void deal_out_long(Shared& s, const TurboArrays& a, math::TileGrid grid, std::uint32_t rank) {
  const List list{a.tile_runs + s.head.begin, a.entries, s.head.n_runs};
  const std::uint32_t n_entries = s.head.n_entries;
  TurboEntry* const sorted = a.scratch + s.head.scratch;
  order_by_bins(s, list, sorted);
  __syncthreads();
  reserve_cells(s, a, grid, rank);
  if (!s.fits) return;
  for (std::uint32_t begin = 0; begin < n_entries;) {
    const std::uint32_t end = group_end(s, begin);
    const TurboEntry* const group = sorted + begin;
    const std::uint32_t n = end - begin;
    TurboEntry from = 0;
    for (std::uint32_t left = n; left > 0;) {
      if (threadIdx.x == 0) s.n = n <= kEntries ? n : 0;
      DepthRange range;
      const auto take = [&](std::uint32_t k, TurboEntry entry) {
        s.entries[k] = entry;
        range.add(depth_of(entry));
      };
      if (n <= kEntries) {
        for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) take(k, group[k]);
      } else {
        const TurboEntry to = left <= kEntries ? ~TurboEntry{0} : round_end(s, group, n, from);
        __syncthreads();
        for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) {
          const TurboEntry entry = group[k];
          if (entry >= from && entry < to) take(atomicAdd(&s.n, 1u), entry);
        }
        from = to;
      }
      __syncthreads();
      left -= s.n;
      sort_entries(s, range);
      count_chunks(s);
      deal_out(s, a);
      __syncthreads();
      if (threadIdx.x < kTurboCells) s.cell_begin[threadIdx.x] += s.cell_n[threadIdx.x];
    }
    begin = end;
  }
}

__global__ void __launch_bounds__(kThreads, resident_blocks(5, kThreads))
    turbo_order_kernel(TurboArrays a, math::TileGrid grid, TurboState* seen) {
  __shared__ Shared s;
  const std::uint32_t rank = blockIdx.x;
  begin_tile(s, a, rank);
  if (s.head.n_entries > kEntries) {
    deal_out_long(s, a, grid, rank);
  } else {
    deal_out_short(s, a, grid, rank);
  }
  end_tile(a, seen);
}

}  // namespace

Status launch_turbo_order(const TurboArrays& a, math::TileGrid grid, TurboState* seen, CUevent_st* counted,
                          Stream stream) {
  turbo_order_kernel<<<a.n_tiles, kThreads, 0, stream>>>(a, grid, seen);
  if (const auto ok = launched("the kernel that orders the lists could not be launched"); !ok) return ok;
  return checked(cudaEventRecord(counted, stream), "an event could not be recorded");
}

}  // namespace rgs::cuda
