// turbo.hpp - launches of the turbo pipeline: lists per tile of 32x32 pixels, ordered in shared memory where they are
// blended. No sort over the frame, and nothing that the host must know before the last kernel is queued.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/cuda/frame.hpp"
#include "rgs/cuda/front_end.hpp"
#include "rgs/result.hpp"

struct CUevent_st;

namespace rgs::cuda {

inline constexpr int kTurboTile = 32;  ///< pixels along a tile's side

/// What a list holds of a Gaussian: bits of its depth (positive: 31), its index, and the cells of the tile that it
/// touches (math::cells_touched()). Entries order by depth, then by index.
using TurboEntry = std::uint64_t;
inline constexpr int kTurboIndexBits = 25;
inline constexpr std::uint64_t kMaxTurboGaussians = std::uint64_t{1} << kTurboIndexBits;

/// An entry on its way to its list.
struct alignas(16) TurboPair {
  TurboEntry entry;
  std::uint32_t tile;
  std::uint32_t rank;  ///< in the list
};
static_assert(sizeof(TurboPair) == 16);

/// Projects n Gaussians, writes splats [n] at the indices of the visible ones, and pairs; adds to counters.instances,
/// .visible and list_length [tiles]. Chunks of compact attributes outside the view are passed over before an attribute
/// is read. Pairs beyond the capacity are counted, not written. v.grid is that of 32x32 tiles. n < kMaxTurboGaussians.
/// Errors: device_failed.
struct TurboEmitArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  ScreenSplat* splats;
  TurboPair* pairs;
  std::uint64_t capacity;
  std::uint32_t* list_length;
  Counters* counters;
};
Status launch_turbo_emit(const TurboEmitArguments& arguments, Stream stream);

/// Sums list_length [n_tiles] into list_begin [n_tiles + 1] and orders the tiles by falling length into tile_order
/// [n_tiles]; then puts each pair's entry where its list says. If counters.instances exceeds the capacity, all lists
/// are empty. `seen` gets a copy of the counters, for the host to read once the first of the two kernels has run:
/// page-locked memory that the device reaches. Its event is recorded then. Errors: device_failed.
struct TurboListArguments {
  const std::uint32_t* list_length;
  std::uint32_t* list_begin;
  std::uint32_t* tile_order;
  std::uint32_t n_tiles;
  const TurboPair* pairs;
  TurboEntry* entries;
  std::uint64_t capacity;
  const Counters* counters;
  Counters* seen;
};
Status launch_turbo_lists(const TurboListArguments& arguments, CUevent_st* counted, Stream stream);

/// Orders each list and blends it. Errors: device_failed.
struct TurboBlendArguments {
  const std::uint32_t* list_begin;  ///< [n_tiles + 1]
  const std::uint32_t* tile_order;  ///< [n_tiles]
  const TurboEntry* entries;
  const ScreenSplat* splats;
  math::TileGrid grid;  ///< of 32x32 tiles
  int width, height;    ///< px
  math::Vec3<float> background;
  PixelArrays target;
  Counters* counters;  ///< .evaluated and .blended; null if nobody counts
};
Status launch_turbo_blend(const TurboBlendArguments& arguments, Stream stream);

}  // namespace rgs::cuda
