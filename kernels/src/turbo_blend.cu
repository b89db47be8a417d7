// turbo_blend.cu - orders a tile's list in shared memory and blends it, a block a tile of 32x32 pixels.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp: fold(), folded_exponent(); docs/RENDERING.md "A pixel"
// In/Out  lists, splats -> pixels
// Cost    an entry: 8 B read, 3 or 4 instructions a step of the sorting network; a (cell, Gaussian) pair that is
//         blended: 48 B gathered by one lane, 32 B of shared memory to each lane, and about 12 instructions a pixel
// Launch  256 threads a tile, longest lists first. A warp has a cell of 16x8 pixels, a thread four pixels of one
//         column: what it reads of a Gaussian, and its polynomial in y, serve all four
// Shared  Shared: entries, their order, Gaussians staged by each warp, histograms; 41 KiB
// Order   exact: by depth, then by index, in every pixel, whatever the order of the list: deterministic
//
// Lists are as long as the scene makes them, shared memory is not: a list longer than kEntries is first moved to
// scratch memory in the order of 1,024 bins of depth, and then taken in rounds of as many bins as fit. Most pixels are
// opaque before the last. A bin that does not fit is cut in finer ones, and so on.
#include <cuda_fp16.h>

#include <cstdint>

#include "block_scan.cuh"
#include "launch.cuh"
#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr int kRows = 4;  // pixels of a thread
using math::kCellHeight;
using math::kCellWidth;
static_assert(kCellHeight == 2 * kRows);
constexpr std::uint32_t kEntries = kTurboEntries;
constexpr int kBinBits = 8;  // of the histogram that cuts a range, a bin a thread
constexpr TurboEntry kBins = TurboEntry{1} << kBinBits;
static_assert(kBins == kThreads);
constexpr int kDepthBins = 1024;  // of the histogram that cuts a long list, by depth
constexpr int kBinsPerThread = kDepthBins / kThreads;

// A Gaussian as a cell's pixels need it; coordinates relative to the cell's first pixel.
struct Staged {
  float4 quadratic;  // xx, xy, yy, x
  float4 rest;       // y, one, colour in FP16: r g, b
};

// A round's order, and the Gaussians that each warp has at hand.
struct Ordered {
  std::uint32_t order[kEntries];  // depth << 11 | position among the entries
  Staged staged[kWarps][32];
};

struct Shared {
  TurboEntry entries[kEntries];
  union {  // first one, then the other
    std::uint32_t exchange[2 * kEntries];
    Ordered ordered;
  };
  std::uint32_t queue[kWarps][64];  // Gaussians that touch the cell, in order
  std::uint32_t bins[kDepthBins];
  std::uint32_t run_begin[kThreads], run_end[kThreads];  // of 256 runs: first entry, inclusive sums of their sizes
  std::uint32_t warp_sums[kWarps];
  std::uint32_t n;  // entries of the round
};

// Orders the keys of the block's threads: element k of thread t is number 256 k + t. A sorting network (Batcher 1968):
// its long strides are between elements of one thread, its short ones between lanes of a warp, and those in between go
// through shared memory, the two halves of `exchange` taking turns.
template <int Elements>
__device__ void sort_keys(std::uint32_t (&key)[Elements], std::uint32_t* exchange) {
  const std::uint32_t thread = threadIdx.x;
  int half = 0;
  const auto compare = [](std::uint32_t own, std::uint32_t other, bool smaller) {
    return smaller ? math::min(own, other) : math::max(own, other);
  };
#pragma unroll
  for (std::uint32_t run = 2; run <= Elements * kThreads; run *= 2) {
#pragma unroll
    for (std::uint32_t stride = run / 2; stride > 0; stride /= 2) {
      if (stride >= kThreads) {
        const int apart = static_cast<int>(stride / kThreads);
#pragma unroll
        for (int k = 0; k < Elements; ++k) {
          if ((k & apart) != 0) continue;
          const bool ascending = ((static_cast<std::uint32_t>(k) * kThreads) & run) == 0;
          const std::uint32_t low = key[k], high = key[k + apart];
          key[k] = compare(low, high, ascending);
          key[k + apart] = compare(low, high, !ascending);
        }
      } else {
        if (stride >= 32) {
#pragma unroll
          for (int k = 0; k < Elements; ++k) exchange[half * Elements * kThreads + k * kThreads + thread] = key[k];
          __syncthreads();
        }
#pragma unroll
        for (int k = 0; k < Elements; ++k) {
          const std::uint32_t other = stride >= 32
                                          ? exchange[half * Elements * kThreads + k * kThreads + (thread ^ stride)]
                                          : __shfl_xor_sync(kFullWarp, key[k], stride);
          const bool ascending = ((static_cast<std::uint32_t>(k) * kThreads + thread) & run) == 0;
          key[k] = compare(key[k], other, ascending == ((thread & stride) == 0));
        }
        if (stride >= 32) half ^= 1;
      }
    }
  }
}

// Position of each of the s.n entries in the order of the entries, into s.ordered.order. Keys of 32 bits, depth above
// and position below, are ordered first. Their depth is relative to the list's own range and may have lost its last
// bits: neighbours of equal depth are then put right by looking at the entries themselves.
template <int Elements>
__device__ void order_entries(Shared& s) {
  constexpr int kPositionBits = 11;
  static_assert(kEntries == 1u << kPositionBits);
  std::uint32_t low = ~0u, high = 0;
  std::uint32_t key[Elements];
#pragma unroll
  for (int k = 0; k < Elements; ++k) {
    const std::uint32_t position = k * kThreads + threadIdx.x;
    key[k] = position < s.n ? static_cast<std::uint32_t>(s.entries[position] >> (kTurboIndexBits + 8)) : ~0u;
    if (position < s.n) low = math::min(low, key[k]), high = math::max(high, key[k]);
  }
  low = reduce_warp(low, [](std::uint32_t a, std::uint32_t b) { return math::min(a, b); });
  high = reduce_warp(high, [](std::uint32_t a, std::uint32_t b) { return math::max(a, b); });
  if (threadIdx.x % 32 == 0) s.run_begin[threadIdx.x / 32] = low, s.run_end[threadIdx.x / 32] = high;
  __syncthreads();
#pragma unroll
  for (int w = 0; w < kWarps; ++w) low = math::min(low, s.run_begin[w]), high = math::max(high, s.run_end[w]);
  // One value less than the depth bits hold stays free: padding comes last.
  const int shift = math::max(0, 32 - __clz(static_cast<int>(high - low + 1)) - (32 - kPositionBits));
#pragma unroll
  for (int k = 0; k < Elements; ++k) {
    const std::uint32_t position = k * kThreads + threadIdx.x;
    key[k] = position < s.n ? (key[k] - low) >> shift << kPositionBits | position : ~0u;
  }
  sort_keys(key, s.exchange);
  __syncthreads();
#pragma unroll
  for (int k = 0; k < Elements; ++k) s.ordered.order[k * kThreads + threadIdx.x] = key[k];
  __syncthreads();
  for (std::uint32_t odd = 0, quiet = 0; quiet < 2; odd ^= 1) {
    bool swapped = false;
    for (std::uint32_t at = 2 * threadIdx.x + odd; at + 1 < s.n; at += 2 * kThreads) {
      const std::uint32_t a = s.ordered.order[at], b = s.ordered.order[at + 1];
      constexpr std::uint32_t kPosition = kEntries - 1;
      if (((a ^ b) & ~kPosition) == 0 && s.entries[a & kPosition] > s.entries[b & kPosition]) {
        s.ordered.order[at] = b, s.ordered.order[at + 1] = a;
        swapped = true;
      }
    }
    quiet = __syncthreads_or(swapped) ? 0 : quiet + 1;
  }
}

__device__ void sort_entries(Shared& s) {
  if (s.n <= kThreads) {
    order_entries<1>(s);
  } else if (s.n <= 2 * kThreads) {
    order_entries<2>(s);
  } else if (s.n <= 4 * kThreads) {
    order_entries<4>(s);
  } else {
    order_entries<8>(s);
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

// Bins of equal ratio of depth, 64 for each power of two from 1/8 on; what lies nearer or farther shares the end bins.
__device__ inline std::uint32_t depth_bin(TurboEntry entry) {
  constexpr int kShift = 23 - 6;
  constexpr int kFirst = (127 - 3) << 6;
  const auto bits = static_cast<std::uint32_t>(entry >> (kTurboIndexBits + 8));
  return static_cast<std::uint32_t>(math::min(math::max(static_cast<int>(bits >> kShift) - kFirst, 0), kDepthBins - 1));
}

// Moves a list to `sorted` in the order of its bins; s.bins then holds the end of each.
__device__ void order_by_bins(Shared& s, const List& list, TurboEntry* sorted) {
  for (int k = 0; k < kBinsPerThread; ++k) s.bins[kThreads * k + threadIdx.x] = 0;
  __syncthreads();
  list.for_each(s, [&s](TurboEntry entry, std::uint32_t) { atomicAdd(s.bins + depth_bin(entry), 1u); });
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
  list.for_each(s, [&](TurboEntry entry, std::uint32_t) { sorted[atomicAdd(s.bins + depth_bin(entry), 1u)] = entry; });
}

// End of the largest number of whole bins from position `begin` on that hold at most kEntries entries, and at least
// one; or, if the next bin holds more, its end, to be cut further.
__device__ std::uint32_t group_end(const Shared& s, std::uint32_t begin) {
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
__device__ TurboEntry round_end(Shared& s, const TurboEntry* entries, std::uint32_t n, TurboEntry begin) {
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

__device__ inline float exp2_approximate(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

struct Accumulated {
  float r = 0, g = 0, b = 0, depth = 0;
  float t = 1;
  std::uint32_t evaluated = 0, blended = 0;
};

// Whether an opacity may exceed kAlphaMax in the cell, also by what rounding can add to the exponent: terms as large as
// these cancel in it, and they are large for needles.
__device__ inline bool may_exceed(const ScreenSplat& splat, float corner_x, float corner_y) {
  constexpr float kLog2AlphaMax = -0.0144996F;
  constexpr float kRounding = 4 * math::kLog2E * 6e-8F;
  const float dx = fabsf(splat.mean.u - corner_x) + kCellWidth, dy = fabsf(splat.mean.v - corner_y) + kCellHeight;
  const float terms = splat.conic.a * dx * dx + splat.conic.c * dy * dy;
  return !(splat.log2_opacity + kRounding * terms < kLog2AlphaMax);
}

__device__ inline Staged stage(const ScreenSplat& splat, float corner_x, float corner_y) {
  const auto f = math::fold(splat.conic, {splat.mean.u - corner_x, splat.mean.v - corner_y}, splat.log2_opacity);
  const __half2 red_green = __floats2half2_rn(splat.color.x, splat.color.y);
  const __half2 blue = __floats2half2_rn(splat.color.z, 0.0F);
  return {{f.xx, f.xy, f.yy, f.x},
          {f.y, f.one, __uint_as_float(*reinterpret_cast<const std::uint32_t*>(&red_green)),
           __uint_as_float(*reinterpret_cast<const std::uint32_t*>(&blue))}};
}

// A Gaussian's opacities in a thread's column of pixels, 0 where a pair is skipped, and its colour.
struct Column {
  float alpha[kRows];
  float r, g, b;
};

template <bool Clamp>
__device__ inline Column column_of(const Staged& s, float x, const float (&y)[kRows]) {
  const math::Folded<float> f{s.quadratic.x, s.quadratic.y, s.quadratic.z, s.quadratic.w, s.rest.x, s.rest.y};
  const std::uint32_t red_green = __float_as_uint(s.rest.z), blue = __float_as_uint(s.rest.w);
  const float2 rg = __half22float2(*reinterpret_cast<const __half2*>(&red_green));
  Column c;
  c.r = rg.x, c.g = rg.y, c.b = __low2float(*reinterpret_cast<const __half2*>(&blue));
  const float constant = fmaf(fmaf(f.xx, x, f.x), x, f.one);
  const float linear = fmaf(f.xy, x, f.y);
#pragma unroll
  for (int k = 0; k < kRows; ++k) {
    const float exponent = fmaf(fmaf(f.yy, y[k], linear), y[k], constant);
    const float alpha = exp2_approximate(exponent);
    c.alpha[k] = exponent >= math::kLog2AlphaMin ? (Clamp ? math::min(alpha, math::kAlphaMax) : alpha) : 0.0F;
  }
  return c;
}

// Blends one Gaussian into a column of pixels. A pixel does not stop at the definition's transmittance of 1e-4 but when
// its whole cell has fallen below it: what comes after adds less than 1e-4.
template <bool Details>
__device__ inline void blend_column(Accumulated (&pixel)[kRows], const Column& c, float z) {
#pragma unroll
  for (int k = 0; k < kRows; ++k) {
    Accumulated& p = pixel[k];
    if (Details && p.t >= math::kTransmittanceMin) {
      ++p.evaluated;
      if (c.alpha[k] > 0) ++p.blended;
    }
    const float weight = c.alpha[k] * p.t;
    p.t -= weight;
    p.r = fmaf(weight, c.r, p.r);
    p.g = fmaf(weight, c.g, p.g);
    p.b = fmaf(weight, c.b, p.b);
    if (Details) p.depth = fmaf(weight, z, p.depth);
  }
}

template <bool Details>
struct Cell {
  Accumulated pixel[kRows];
  float corner_x, corner_y;  // first pixel of the cell, px
  float x, y[kRows];         // the thread's pixels, relative to it
  bool done = false;         // the same in all lanes

  template <bool Clamp>
  __device__ void blend_staged(const Staged* staged, int n, float z) {
#pragma unroll 2
    for (int j = 0; j < n; ++j) {
      blend_column<Details>(pixel, column_of<Clamp>(staged[j], x, y), Details ? __shfl_sync(kFullWarp, z, j) : 0.0F);
    }
  }

  // Blends `n` <= 32 queued Gaussians.
  __device__ void blend(const ScreenSplat* splats, Shared& s, int warp, int lane, int n) {
    float z = 0;
    bool clamp = false;
    if (lane < n) {
      const ScreenSplat splat = splats[s.queue[warp][lane]];
      s.ordered.staged[warp][lane] = stage(splat, corner_x, corner_y);
      z = splat.z;
      clamp = may_exceed(splat, corner_x, corner_y);
    }
    __syncwarp();
    // One opacity above kAlphaMax, and all of the 32 are clamped; mostly there is none.
    __any_sync(kFullWarp, clamp) ? blend_staged<true>(s.ordered.staged[warp], n, z)
                                 : blend_staged<false>(s.ordered.staged[warp], n, z);
    bool opaque = true;
#pragma unroll
    for (const Accumulated& p : pixel) opaque = opaque && p.t < math::kTransmittanceMin;
    done = __all_sync(kFullWarp, opaque);
  }

  // Blends what the round's ordered entries hold for this cell.
  __device__ void blend_round(const ScreenSplat* splats, Shared& s, int warp, int lane) {
    std::uint32_t* const queue = s.queue[warp];
    int queued = 0;
    for (std::uint32_t begin = 0; begin < s.n && !done; begin += 32) {
      const TurboEntry entry = begin + static_cast<std::uint32_t>(lane) < s.n
                                   ? s.entries[s.ordered.order[begin + lane] & (kEntries - 1)]
                                   : 0;
      const bool touches = (entry >> warp & 1) != 0;
      const std::uint32_t lanes = __ballot_sync(kFullWarp, touches);
      if (touches) {
        queue[queued + __popc(lanes & ((1u << lane) - 1))] =
            static_cast<std::uint32_t>(entry >> 8) & static_cast<std::uint32_t>(kMaxTurboGaussians - 1);
      }
      queued += __popc(lanes);
      __syncwarp();
      if (queued >= 32) {
        blend(splats, s, warp, lane, 32);
        queued -= 32;
        const std::uint32_t left = queue[32 + lane];
        __syncwarp();
        queue[lane] = left;
        __syncwarp();
      }
    }
    if (!done && queued > 0) blend(splats, s, warp, lane, queued);
  }
};

template <bool Details>
__device__ void store(const TurboBlendArguments& a, const Cell<Details>& cell) {
  const PixelArrays& t = a.target;
  const int x = static_cast<int>(cell.corner_x + cell.x), y = static_cast<int>(cell.corner_y + cell.y[0]);
  if (x >= a.width) return;
#pragma unroll
  for (int k = 0; k < kRows; ++k) {
    if (y + k >= a.height) return;
    const Accumulated& p = cell.pixel[k];
    const math::Pixel<float> pixel{p.r, p.g, p.b, p.depth, p.t};
    const auto i = static_cast<std::size_t>(y + k) * static_cast<std::size_t>(a.width) + static_cast<std::size_t>(x);
    if (t.rgb != nullptr) {
      const auto color = math::resolve(pixel, a.background);
      t.rgb[3 * i] = color.x, t.rgb[3 * i + 1] = color.y, t.rgb[3 * i + 2] = color.z;
    }
    if (t.alpha != nullptr) t.alpha[i] = 1 - pixel.transmittance;
    if constexpr (Details) {
      if (t.depth != nullptr) t.depth[i] = math::expected_depth(pixel);
      if (t.evaluated != nullptr) t.evaluated[i] = p.evaluated;
      if (t.blended != nullptr) t.blended[i] = p.blended;
      if (a.count_pairs) {
        Counters& counters = a.arrays.state->counters;
        atomicAdd(reinterpret_cast<unsigned long long*>(&counters.evaluated), p.evaluated);
        atomicAdd(reinterpret_cast<unsigned long long*>(&counters.blended), p.blended);
      }
    }
  }
}

// The block's tile: the longest lists come first.
__device__ std::uint32_t tile_of_block(const TurboArrays& a) {
  const std::uint32_t lane = threadIdx.x % 32;
  const std::uint32_t size = a.state->class_size[lane];
  const std::uint32_t end = inclusive_warp_sum(size);
  const int length = __ffs(static_cast<int>(__ballot_sync(kFullWarp, end > blockIdx.x))) - 1;
  const std::uint32_t begin = __shfl_sync(kFullWarp, end - size, length);
  return a.classes[static_cast<std::uint32_t>(length) * a.n_tiles + blockIdx.x - begin];
}
static_assert(kTurboClasses == 32, "a lane a class");

template <bool Details>
__global__ void __launch_bounds__(kThreads, 4) turbo_blend_kernel(TurboBlendArguments a) {
  __shared__ Shared memory;
  Shared& s = memory;
  const int warp = static_cast<int>(threadIdx.x / 32), lane = static_cast<int>(threadIdx.x % 32);
  const std::uint32_t tile = tile_of_block(a.arrays);
  const TurboList head = a.arrays.lists[tile];
  const List list{a.arrays.tile_runs + head.begin, a.arrays.entries, head.n_runs};
  const int tile_x = static_cast<int>(tile) % a.grid.columns, tile_y = static_cast<int>(tile) / a.grid.columns;

  Cell<Details> cell;
  cell.corner_x = static_cast<float>(tile_x * kTurboTile + kCellWidth * (warp % 2));
  cell.corner_y = static_cast<float>(tile_y * kTurboTile + kCellHeight * (warp / 2));
  cell.x = static_cast<float>(lane % kCellWidth);
  for (int k = 0; k < kRows; ++k) cell.y[k] = static_cast<float>(kRows * (lane / kCellWidth) + k);
  cell.done = cell.corner_x >= static_cast<float>(a.width) || cell.corner_y >= static_cast<float>(a.height);
  for (int k = 0; k < kRows; ++k) {  // a pixel outside the image keeps nobody waiting
    const bool inside = cell.corner_x + cell.x < static_cast<float>(a.width) &&
                        cell.corner_y + cell.y[k] < static_cast<float>(a.height);
    cell.pixel[k].t = inside ? 1.0F : 0.0F;
  }

  // Orders the round's s.n entries and blends them; true once all pixels are opaque.
  const auto blend_round = [&] {
    sort_entries(s);
    if (!cell.done) cell.blend_round(a.splats, s, warp, lane);
    return __syncthreads_and(cell.done) != 0;
  };
  if (head.n_entries <= kEntries) {
    list.for_each(s, [&s](TurboEntry entry, std::uint32_t k) { s.entries[k] = entry; });
    if (threadIdx.x == 0) s.n = head.n_entries;
    __syncthreads();
    if (head.n_entries > 0) blend_round();
  } else {
    TurboEntry* const sorted = a.arrays.scratch + head.scratch;
    order_by_bins(s, list, sorted);
    bool opaque = false;
    for (std::uint32_t begin = 0; begin < head.n_entries && !opaque;) {
      const std::uint32_t end = group_end(s, begin);
      const TurboEntry* const group = sorted + begin;
      const std::uint32_t n = end - begin;
      TurboEntry from = 0;
      for (std::uint32_t left = n; left > 0 && !opaque;) {
        if (threadIdx.x == 0) s.n = n <= kEntries ? n : 0;
        if (n <= kEntries) {
          for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) s.entries[k] = group[k];
        } else {
          const TurboEntry to = left <= kEntries ? ~TurboEntry{0} : round_end(s, group, n, from);
          __syncthreads();
          for (std::uint32_t k = threadIdx.x; k < n; k += kThreads) {
            const TurboEntry entry = group[k];
            if (entry >= from && entry < to) s.entries[atomicAdd(&s.n, 1u)] = entry;
          }
          from = to;
        }
        __syncthreads();
        left -= s.n;
        opaque = blend_round();
      }
      begin = end;
    }
  }
  store(a, cell);
}

}  // namespace

Status launch_turbo_blend(const TurboBlendArguments& a, Stream stream) {
  const PixelArrays& t = a.target;
  const bool details = t.depth != nullptr || t.evaluated != nullptr || t.blended != nullptr || a.count_pairs;
  const auto blocks = static_cast<std::uint32_t>(a.grid.columns * a.grid.rows);
  details ? turbo_blend_kernel<true><<<blocks, kThreads, 0, stream>>>(a)
          : turbo_blend_kernel<false><<<blocks, kThreads, 0, stream>>>(a);
  return launched("the turbo blending kernel could not be launched");
}

}  // namespace rgs::cuda
