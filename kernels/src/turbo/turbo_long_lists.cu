// turbo_long_lists.cu - moves long lists to scratch memory in the order of bins of depth, cut into units that blocks
// order.
// SPDX-License-Identifier: Apache-2.0
//
// In/Out  lists, tile_runs, entries, long_lists, slices -> scratch, units, cells; bins, unit_cells
// Cost    an entry: 8 B read three times, 8 B written anywhere; an atomic addition a slice and bin, twice
// Launch  256 threads a slice of 1,024 to 4,096 entries; as many blocks as the device holds at a time take slices in turn
// Shared  4 KiB of bins, 2 KiB of runs; the last block of a list 4 KiB more
// Order   of entries in a bin, of lists' units and cells in memory: any
//
// One block would take as long as the list is, and the whole frame would wait for it.
#include <cstdint>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "turbo/place_cells.cuh"
#include "turbo/read_list.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr std::uint32_t kBinsPerThread = kTurboBins / kThreads;
static_assert(kBinsPerThread == 4, "a thread reads its bins as one vector");

// Ranges of a very long list's depths, from a sample: a few distant Gaussians would otherwise leave few bins to the
// others, and each bin would be read once for every share of it. A stretch has six of 64 samples, fewer at both ends.
struct Stretches {
  static constexpr std::uint32_t kN = 16, kBins = kTurboBins / kN, kSample = 64;
  std::uint32_t begin[kN + 1];  // bits of depth
  float bins[kN];               // bins a unit of the bits
  std::uint32_t sample[kSample], in_order[kSample];

  // First sample of a stretch.
  __device__ static std::uint32_t first(std::uint32_t k) {
    return k < 4 ? (1u << k) / 2 : k < 13 ? 8 + 6 * (k - 4) : kSample - (16u >> (k - 11));
  }
};

// Bins of equal width in the bits of depth, which is nearly equal ratio, of the list or of a stretch; the first and
// last also hold what is outside.
class DepthBins {
 public:
  // All threads of the block call it; all blocks compute the same.
  __device__ DepthBins(const TurboArrays& a, const TurboLongList& list, Stretches& stretches)
      : nearest_(list.nearest),
        dropped_(a.state->dropped),
        stretches_(list.n_entries >= kTurboSampledList ? &stretches : nullptr) {
    constexpr int kBits = 10;
    static_assert(kTurboBins == 1 << kBits);
    shift_ = math::max(0, 32 - __clz(static_cast<int>(list.farthest - list.nearest)) - kBits);
    if (stretches_ != nullptr) find(a, list, stretches, dropped_);
  }
  __device__ std::uint32_t of(TurboEntry entry) const {
    const std::uint32_t depth = depth_of(entry, dropped_);
    if (stretches_ == nullptr) return depth > nearest_ ? math::min((depth - nearest_) >> shift_, kTurboBins - 1) : 0;
    std::uint32_t k = 0;
#pragma unroll
    for (std::uint32_t step = Stretches::kN / 2; step > 0; step /= 2) {
      if (depth >= stretches_->begin[k + step]) k += step;
    }
    const std::uint32_t begin = stretches_->begin[k];
    const auto in_stretch =
        static_cast<std::uint32_t>(static_cast<float>(math::max(depth, begin) - begin) * stretches_->bins[k]);
    return Stretches::kBins * k + math::min(in_stretch, Stretches::kBins - 1);
  }

 private:
  __device__ static void find(const TurboArrays& a, const TurboLongList& list, Stretches& s, int dropped) {
    constexpr std::uint32_t kSample = Stretches::kSample;
    const std::uint32_t own = threadIdx.x;
    __syncthreads();  // all have read the list before
    if (own < kSample) {
      const TurboList all = a.lists[list.tile];
      const TurboRun run = a.tile_runs[all.begin + std::uint64_t{own} * all.n_runs / kSample];
      s.sample[own] = depth_of(a.entries[run.begin + own * 7919 % run.n], dropped);
    }
    __syncthreads();
    if (own < kSample) {
      std::uint32_t place = 0;
#pragma unroll 16
      for (std::uint32_t k = 0; k < kSample; ++k) {
        place += s.sample[k] < s.sample[own] || (s.sample[k] == s.sample[own] && k < own);
      }
      s.in_order[place] = s.sample[own];
    }
    __syncthreads();
    if (own <= Stretches::kN) {
      s.begin[own] = own == 0              ? math::min(s.in_order[0], list.nearest)
                     : own < Stretches::kN ? s.in_order[Stretches::first(own)]
                                           : math::max(s.in_order[kSample - 1], list.farthest) + 1;
    }
    __syncthreads();
    if (own < Stretches::kN) {
      const std::uint32_t width = s.begin[own + 1] - s.begin[own];
      s.bins[own] = width > 0 ? static_cast<float>(Stretches::kBins) / static_cast<float>(width) : 0;
    }
    __syncthreads();
  }

  std::uint32_t nearest_;
  int dropped_, shift_;
  const Stretches* stretches_;
};

__device__ TurboRuns runs_of(const TurboArrays& a, const TurboLongList& list, std::uint32_t slice) {
  const TurboList all = a.lists[list.tile];
  const std::uint32_t each = (all.n_runs + list.n_slices - 1) / list.n_slices;
  const std::uint32_t begin = math::min((slice - list.first_slice) * each, all.n_runs);
  return {a.tile_runs + all.begin + begin, a.entries, math::min(each, all.n_runs - begin)};
}

struct Counting {
  Stretches stretches;
  TurboRuns::Places<kThreads> places;
  std::uint32_t bins[kTurboBins];  // entries of each; in the last block of a list, their offsets
  std::uint32_t cell_n[kTurboCells];
  // Of the last block of a list:
  std::uint32_t parts[kTurboBins + 1];  // offsets; the last is the list's end
  std::uint32_t n_parts;
  std::uint32_t warp_sums[kThreads / 32];
  std::uint32_t first_unit;
  bool is_last, fits;
};

__device__ void clear(std::uint32_t (&bins)[kTurboBins]) {
  for (std::uint32_t k = threadIdx.x; k < kTurboBins; k += kThreads) bins[k] = 0;
}

// Offsets of the bins from `first` on, here and for turbo_scatter_kernel.
__device__ void place_bins(Counting& s, std::uint32_t first, std::uint32_t* bins) {
  const uint4 n = __ldcg(reinterpret_cast<const uint4*>(bins) + threadIdx.x);  // sums of other blocks: not from L1
  const std::uint32_t sum = n.x + n.y + n.z + n.w;
  const std::uint32_t begin = first + inclusive_block_sum<kThreads>(sum, s.warp_sums) - sum;
  const uint4 begins{begin, begin + n.x, begin + n.x + n.y, begin + n.x + n.y + n.z};
  reinterpret_cast<uint4*>(bins)[threadIdx.x] = begins;
  std::uint32_t* const own = s.bins + kBinsPerThread * threadIdx.x;
  own[0] = begins.x, own[1] = begins.y, own[2] = begins.z, own[3] = begins.w;
  __syncthreads();
}

// Cuts parts: a bin starts one if it is the first past a multiple of kTurboPart entries.
__device__ void cut_parts(Counting& s, std::uint32_t first, std::uint32_t n) {
  const std::uint32_t* const bins = s.bins + kBinsPerThread * threadIdx.x;
  std::uint32_t before = threadIdx.x > 0 ? bins[-1] - first : 0, n_begun = 0;
  bool begins[kBinsPerThread];
#pragma unroll
  for (std::uint32_t k = 0; k < kBinsPerThread; ++k) {
    const std::uint32_t begin = bins[k] - first;
    begins[k] = begin < n && (threadIdx.x + k == 0 || begin / kTurboPart != before / kTurboPart);
    n_begun += begins[k];
    before = begin;
  }
  const std::uint32_t end = inclusive_block_sum<kThreads>(n_begun, s.warp_sums);
  std::uint32_t part = end - n_begun;
#pragma unroll
  for (std::uint32_t k = 0; k < kBinsPerThread; ++k) {
    if (begins[k]) s.parts[part++] = bins[k];
  }
  if (threadIdx.x == kThreads - 1) {
    s.n_parts = end;
    s.parts[end] = first + n;
  }
  __syncthreads();
}

// Makes units of a list's parts. `own`: the list's number.
__device__ void make_units(Counting& s, const TurboArrays& a, std::uint32_t own) {
  const std::uint32_t first_part = kBinsPerThread * threadIdx.x;
  const std::uint32_t end_part = math::min(first_part + kBinsPerThread, s.n_parts);
  std::uint32_t n_units = 0;
  for (std::uint32_t p = first_part; p < end_part; ++p) n_units += turbo_shares(s.parts[p + 1] - s.parts[p]);
  const std::uint32_t end = inclusive_block_sum<kThreads>(n_units, s.warp_sums);
  if (threadIdx.x == kThreads - 1) {
    s.first_unit = atomicAdd(&a.state->n_units, end);
    a.long_lists[own].first_unit = s.first_unit;
  }
  __syncthreads();
  std::uint32_t unit = s.first_unit + end - n_units;
  for (std::uint32_t p = first_part; p < end_part; ++p) {
    const std::uint32_t shares = turbo_shares(s.parts[p + 1] - s.parts[p]);
    for (std::uint32_t share = 0; share < shares; ++share, ++unit) {
      a.units[unit] = {s.parts[p], s.parts[p + 1], own, share};
      for (std::uint32_t c = 0; c < kTurboCells; ++c) a.unit_cells[kTurboCells * unit + c] = 0;
    }
  }
}

// Adds a slice to its list's sums; the last slice cuts the list into units.
__device__ void count_slice(Counting& s, const TurboArrays& a, math::TileGrid grid, std::uint32_t slice,
                            TurboState* seen) {
  const std::uint32_t own = a.slices[slice];
  TurboLongList& list = a.long_lists[own];
  std::uint32_t* const sums = a.bins + std::uint64_t{kTurboBins} * own;
  clear(s.bins);
  if (threadIdx.x < kTurboCells) s.cell_n[threadIdx.x] = 0;
  __syncthreads();
  const DepthBins bins(a, list, s.stretches);
  CellCounter cells(s.cell_n);
  runs_of(a, list, slice).for_each(s.places, [&](TurboEntry entry, std::uint32_t) {
    atomicAdd(s.bins + bins.of(entry), 1u);
    cells.add(entry);
  });
  cells.flush();
  __syncthreads();
  for (std::uint32_t k = threadIdx.x; k < kTurboBins; k += kThreads) {
    if (s.bins[k] > 0) atomicAdd(sums + k, s.bins[k]);
  }
  if (threadIdx.x < kTurboCells) atomicAdd(list.cell_n + threadIdx.x, s.cell_n[threadIdx.x]);
  __threadfence();
  __syncthreads();
  if (threadIdx.x == 0) s.is_last = atomicAdd(&list.counted, 1u) == list.n_slices - 1;
  __syncthreads();
  if (!s.is_last) return;
  __threadfence();
  if (threadIdx.x < kTurboCells) s.cell_n[threadIdx.x] = __ldcg(list.cell_n + threadIdx.x);  // with other blocks' sums
  place_bins(s, list.scratch, sums);
  const std::uint32_t rank = threadIdx.x < 32 ? rank_of(own_class_begin(a), list.n_entries, list.in_class) : 0;
  if (threadIdx.x < kTurboCells) {
    const CellPlace place = place_cells(a, grid, rank, list.tile, s.cell_n);
    list.cell_begin[threadIdx.x] = place.begin;
    if (threadIdx.x == 0) {
      s.fits = place.fits;
      end_tile(a, seen);
    }
  }
  __syncthreads();
  if (!s.fits) return;
  cut_parts(s, list.scratch, list.n_entries);
  make_units(s, a, own);
}

// ptxas would take 48 registers on 9.0, for five blocks.
__global__ void __launch_bounds__(kThreads, resident_on_90(6))
    turbo_count_kernel(TurboArrays a, math::TileGrid grid, TurboState* seen) {
  __shared__ Counting s;
  for (std::uint32_t slice = blockIdx.x; slice < a.state->n_slices; slice += gridDim.x) {
    count_slice(s, a, grid, slice, seen);
    __syncthreads();
  }
}

struct Scattering {
  Stretches stretches;
  TurboRuns::Places<kThreads> places;
  std::uint32_t bins[kTurboBins];  // entries of the slice; then the place of the next one
};

__global__ void __launch_bounds__(kThreads) turbo_scatter_kernel(TurboArrays a) {
  __shared__ Scattering s;
  for (std::uint32_t slice = blockIdx.x; slice < a.state->n_slices; slice += gridDim.x) {
    const std::uint32_t own = a.slices[slice];
    const TurboLongList& list = a.long_lists[own];
    const DepthBins bins(a, list, s.stretches);
    const TurboRuns runs = runs_of(a, list, slice);
    clear(s.bins);
    __syncthreads();
    runs.for_each(s.places, [&](TurboEntry entry, std::uint32_t) { atomicAdd(s.bins + bins.of(entry), 1u); });
    std::uint32_t* const places = a.bins + std::uint64_t{kTurboBins} * own;
    for (std::uint32_t k = threadIdx.x; k < kTurboBins; k += kThreads) {
      if (s.bins[k] > 0) s.bins[k] = atomicAdd(places + k, s.bins[k]);
    }
    __syncthreads();
    runs.for_each(s.places,
                  [&](TurboEntry entry, std::uint32_t) { a.scratch[atomicAdd(s.bins + bins.of(entry), 1u)] = entry; });
  }
}

}  // namespace

Status launch_turbo_long_lists(const TurboArrays& a, math::TileGrid grid, TurboState* seen, Stream stream) {
  // More blocks of the other kernel may fit, but both walk the same slices.
  const auto blocks = resident_grid<turbo_count_kernel>(kThreads);
  if (!blocks) return tl::unexpected(blocks.error());
  turbo_count_kernel<<<*blocks, kThreads, 0, stream>>>(a, grid, seen);
  if (const auto ok = launched("the kernel that counts the long lists could not be launched"); !ok) return ok;
  turbo_scatter_kernel<<<*blocks, kThreads, 0, stream>>>(a);
  return launched("the kernel that moves the long lists could not be launched");
}

}  // namespace rgs::cuda
