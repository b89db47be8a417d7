// turbo.hpp - launches of the turbo pipeline: lists per tile, each ordered on its own and dealt out to the cells that
// are blended, without a sort over the frame or a read-back before the last kernel is queued. README.md defines the
// words, turbo_geometry.hpp the sizes of tiles and cells.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>

#include "common/cut.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"
#include "sorted/front_end.hpp"
#include "turbo/turbo_geometry.hpp"

#ifndef RGS_TURBO_FRONT_SHARE
#define RGS_TURBO_FRONT_SHARE 512
#endif
#ifndef RGS_TURBO_SEGMENT
#define RGS_TURBO_SEGMENT 1024
#endif

namespace rgs::cuda {

/// Entries begin .. begin + n - 1 of one tile, written by one block; n > 0.
struct TurboRun {
  std::uint32_t begin, n;
};
/// A run before it is placed in its tile's list.
struct alignas(16) TurboTileRun {
  TurboRun run;
  std::uint32_t tile;
  std::uint32_t in_tile;  ///< index among the tile's runs
};
static_assert(sizeof(TurboTileRun) == 16);

/// A tile's list: runs begin .. begin + n_runs - 1 with n_entries in all. `number` is its index among the long lists if
/// it has kTurboRound entries or more, else within its class.
struct TurboList {
  std::uint32_t begin, n_runs, n_entries, number;
};
inline constexpr std::uint32_t kTurboRound = 2048;  ///< entries that a block orders at a time; a power of two
struct alignas(16) TurboRankedList {
  std::uint32_t begin, n_runs, n_entries, tile;
};

/// A cell's Gaussians begin .. begin + n - 1 of TurboArrays::cell_gaussians, in order.
struct alignas(16) TurboCell {
  std::uint32_t begin, n;
  std::uint32_t x, y;  ///< first pixel
};
static_assert(sizeof(TurboCell) == 16);

/// A Gaussian whose bounding box has many tiles, set aside for a kernel in which tiles search theirs.
struct alignas(16) TurboLargeGaussian {
  math::Ellipse<float> ellipse;
  std::uint32_t depth;  ///< turbo_depth()
  std::uint32_t index;
  std::uint32_t listed;  ///< 1 once it has an entry
  std::uint32_t unused[4];
};
static_assert(sizeof(TurboLargeGaussian) == 64);
/// Its bounding box: tiles x0 <= x < x1, y0 <= y < y1.
struct alignas(8) TurboBox {
  std::uint16_t x0, y0, x1, y1;
};

/// A long list is moved to scratch memory in the order of kTurboBins bins of depth, slice by slice, and cut into parts
/// of neighbouring bins. It is ordered in units: parts, or shares of a part larger than a round.
struct alignas(16) TurboLongList {
  std::uint32_t tile;
  std::uint32_t in_class;               ///< index of the tile within its class
  std::uint32_t scratch;                ///< offset of its n_entries in TurboArrays::scratch
  std::uint32_t first_slice, n_slices;  ///< each slice has the next ceil(n_runs / n_slices) of its runs
  std::uint32_t nearest, farthest;      ///< depth_of(): range of a sample of the entries
  std::uint32_t counted;                ///< slices counted so far
  std::uint32_t n_entries;
  std::uint32_t first_unit;               ///< units are numbered in order of depth
  std::uint32_t cell_n[kTurboCells];      ///< Gaussians of its cells
  std::uint32_t cell_begin[kTurboCells];  ///< and their offsets in TurboArrays::cell_gaussians
};
inline constexpr std::uint32_t kTurboBins = 1024;
inline constexpr std::uint32_t kTurboSlice = 1024;  ///< least average number of entries of a list's slices
/// Entries of a slice of a list of n in a frame of `entries`: short slices if there are few entries, so that all blocks
/// get some; longer ones for a long list, since its slices add to the same bins.
RGS_HD constexpr std::uint32_t turbo_slice(std::uint64_t entries, std::uint32_t n) {
  return static_cast<std::uint32_t>(math::clamp(math::max(entries / 2048, std::uint64_t{n / 16}),
                                                std::uint64_t{kTurboSlice}, std::uint64_t{4 * kTurboSlice}));
}
inline constexpr std::uint32_t kTurboSliceRuns = 256;  ///< runs of a slice, at most
inline constexpr std::uint32_t kTurboPart = 1024;      ///< entries of a part, up to the length of a bin
inline constexpr std::uint32_t kTurboShare = 1024;     ///< entries of a share, up to a sample's error

/// Lists of so many entries choose their bins by a sample, since parts of many shares are read many times.
inline constexpr std::uint32_t kTurboSampledList = 1u << 16;

/// Of the part begin .. end - 1 of TurboArrays::scratch: all of it, or a share if it has more than kTurboRound entries.
struct alignas(16) TurboUnit {
  std::uint32_t begin, end;
  std::uint32_t long_list;
  std::uint32_t share;
};
/// Number of units of a part of n entries.
RGS_HD constexpr std::uint32_t turbo_shares(std::uint32_t n) {
  if (n <= kTurboRound) return 1;
  const std::uint32_t shares = (n + kTurboShare - 1) / kTurboShare;
  return shares < kTurboRound / 2 ? shares : kTurboRound / 2;
}

/// A cell of a long list with more Gaussians than its front. After that, if any transmittance is left, the rest is
/// blended in segments side by side, each as if nothing preceded it. Transmittance is associative: two neighbouring
/// segments combine to one, and that is put behind what precedes it. Segments come in waves of 1, 2, 4, ..., so that
/// when one starts it is mostly known whether the ones before left any transmittance.
struct alignas(16) TurboLongCell {
  std::uint32_t cell;           ///< in TurboArrays::cells
  std::uint32_t front;          ///< Gaussians before the first segment
  std::uint32_t n_segments;     ///< 1 or more
  std::uint32_t segment_n;      ///< Gaussians of a segment, fewer in the last
  std::uint32_t first_segment;  ///< in TurboArrays::segment_pixels and segment_done
  std::uint32_t waves_done;     ///< a bit each
  std::uint32_t lock;           ///< 1 while a block joins waves
  std::uint32_t n_joined;       ///< waves joined, in order
  std::uint32_t is_opaque;      ///< later waves do not show; 1 also once all are joined
  std::uint32_t unused[3];
};
/// Gaussians of a segment, or more if there are many.
inline constexpr std::uint32_t kTurboSegment = RGS_TURBO_SEGMENT;
inline constexpr std::uint32_t kTurboWaves = 10;
inline constexpr std::uint32_t kTurboMaxSegments = (1u << kTurboWaves) - 1;  ///< of a cell
/// Gaussians of a long list's cell that its own block blends, in a frame of so many entries: as many as keep all blocks
/// of a large device busy, since segments cost more. The same on every device, because a frame's bytes depend on it.
RGS_HD constexpr std::uint32_t turbo_front(std::uint64_t entries) {
  const std::uint64_t share = entries / RGS_TURBO_FRONT_SHARE / kTurboSegment * kTurboSegment;
  return share > kTurboSegment ? static_cast<std::uint32_t>(share) : kTurboSegment;
}
struct TurboSegment {
  std::uint32_t long_cell, in_cell;
};
/// A segment's colour and transmittance for a pixel.
struct alignas(16) TurboPixel {
  float r, g, b, transmittance;
};
static_assert(kTurboSegment % 128 == 0);

/// Tiles are classed by list length and start longest first, so that none runs alone at the end.
inline constexpr int kTurboClasses = 32;
/// Two classes for each power of two from 2^5; 0 is the longest, the last but one the shortest, the last is for empty
/// lists.
RGS_HD constexpr int turbo_class(std::uint32_t length) {
  if (length < 32) return length == 0 ? kTurboClasses - 1 : kTurboClasses - 2;
  int log2 = 5;
  while (length >> (log2 + 1) != 0) ++log2;
  const int half = static_cast<int>(length >> (log2 - 1)) & 1;
  const int longer = 2 * (log2 - 5) + half;
  return longer < kTurboClasses - 3 ? kTurboClasses - 3 - longer : 0;
}
static_assert(turbo_class(kTurboRound) < turbo_class(kTurboRound - 1), "long lists have the first ranks");

/// A frame with at most so many runs is sparse: most of its tiles are empty, and a block for each would cost more than
/// everything else.
RGS_HD constexpr std::uint32_t sparse_tiles(std::uint32_t n_tiles) {
  return n_tiles / 8 + 1;
}

/// Device state of a frame, zeroed before it. Arrays [tiles] follow in the same memory: see TurboState::bytes().
struct TurboState {
  Counters counters;
  std::uint64_t runs;               ///< written or not
  std::uint32_t n_large_gaussians;  ///< in TurboArrays::large_gaussians, written or not
  std::uint32_t n_placed;           ///< runs placed in their tile's list
  std::uint32_t n_scratch;          ///< entries of the long lists
  std::uint32_t n_ordered;          ///< tiles whose cells have their places
  std::uint32_t n_long_lists, n_slices, n_units;
  std::uint32_t n_taken;   ///< units taken by a block
  std::uint64_t in_cells;  ///< Gaussians of all cells, written or not
  std::uint32_t n_long_cells, n_segments;
  std::uint32_t n_segments_taken;    ///< segments taken by a block
  std::uint32_t n_long_cells_taken;  ///< of the long lists' cells, likewise
  int dropped;                       ///< bits of entries' depths
  std::uint32_t unused;
  std::uint32_t wave_size[kTurboWaves];
  std::uint32_t class_size[kTurboClasses];

  /// With a TurboCount for each tile.
  static std::uint64_t bytes(std::uint32_t n_tiles) { return sizeof(TurboState) + 8 * std::uint64_t{n_tiles}; }
};
/// Entries of a tile; its runs << 32.
using TurboCount = std::uint64_t;
static_assert(sizeof(TurboState) % 16 == 0);

/// The front end's entries, and the lists made of them.
struct TurboArrays {
  TurboState* state;
  std::uint32_t n_tiles;
  TurboEntry* entries;                  ///< [entry_capacity]
  TurboTileRun* runs;                   ///< [run_capacity]
  TurboRun* tile_runs;                  ///< [run_capacity] by tile
  TurboLargeGaussian* large_gaussians;  ///< [large_capacity]
  TurboBox* large_boxes;                ///< [large_capacity]
  TurboEntry* scratch;                  ///< [entry_capacity] entries of long lists
  TurboLongList* long_lists;            ///< [TurboLongListSizes::lists], and so on
  TurboUnit* units;
  std::uint32_t* unit_cells;      ///< [units, kTurboCells] entries that touch each cell, plus 1; 0 while unknown
  std::uint32_t* bins;            ///< [lists, kTurboBins] entries of each bin; then the place of its next one
  std::uint32_t* slices;          ///< list of each slice
  TurboList* lists;               ///< [n_tiles]
  TurboRankedList* ranked;        ///< [n_tiles] by rank
  TurboCell* cells;               ///< [n_tiles, kTurboCells] by rank
  std::uint32_t* cell_gaussians;  ///< [cell_capacity]
  TurboLongCell* long_cells;      ///< [TurboLongCellSizes::cells]
  TurboPixel* long_cell_pixels;   ///< [cells, pixels of a cell] colour and transmittance of the joined waves
  TurboPixel* segment_pixels;     ///< [segments, pixels of a cell] of each segment
  std::uint32_t* segment_done;    ///< [segments]
  TurboSegment* waves;            ///< [kTurboWaves, segments]
  std::uint64_t entry_capacity, run_capacity, large_capacity, cell_capacity;
};

/// Upper bounds on long cells and segments for so many Gaussians of cells.
struct TurboLongCellSizes {
  std::uint64_t cells, segments;
  static constexpr std::uint64_t kPixels = kTurboCellWidth * kTurboCellHeight;

  static constexpr TurboLongCellSizes of(std::uint64_t in_cells) {
    return {in_cells / kTurboSegment, in_cells / kTurboSegment};
  }
  constexpr std::uint64_t bytes() const {
    return cells * (sizeof(TurboLongCell) + 16 * kPixels) +
           segments * (16 * kPixels + 4 + kTurboWaves * sizeof(TurboSegment));
  }
  /// Lays out all arrays in `memory`, which has bytes().
  void lay_out(void* memory, TurboArrays& to) const {
    if (memory == nullptr) return;
    to.long_cells = static_cast<TurboLongCell*>(memory);
    to.long_cell_pixels = reinterpret_cast<TurboPixel*>(to.long_cells + cells);
    to.segment_pixels = to.long_cell_pixels + cells * kPixels;
    to.waves = reinterpret_cast<TurboSegment*>(to.segment_pixels + segments * kPixels);
    to.segment_done = reinterpret_cast<std::uint32_t*>(to.waves + kTurboWaves * segments);
  }
};

/// Upper bounds on long lists and their parts for so many entries and runs.
struct TurboLongListSizes {
  std::uint64_t lists, units, slices;

  static constexpr TurboLongListSizes of(std::uint64_t entries, std::uint64_t runs) {
    const std::uint64_t lists = entries / kTurboRound;
    return {lists, 2 * (entries / kTurboShare) + 2 * lists, entries / kTurboSlice + runs / kTurboSliceRuns + 2 * lists};
  }
  /// Of all five arrays.
  constexpr std::uint64_t bytes() const {
    return lists * (sizeof(TurboLongList) + 4 * kTurboBins) + units * (sizeof(TurboUnit) + 4 * kTurboCells) +
           4 * slices;
  }
  /// Lays out all arrays in `memory`, which has bytes().
  void lay_out(void* memory, TurboArrays& to) const {
    if (memory == nullptr) return;
    to.long_lists = static_cast<TurboLongList*>(memory);
    to.units = reinterpret_cast<TurboUnit*>(to.long_lists + lists);
    to.bins = reinterpret_cast<std::uint32_t*>(to.units + units);  // aligned to 16 bytes: four at a time
    to.unit_cells = to.bins + lists * kTurboBins;
    to.slices = to.unit_cells + units * kTurboCells;
  }
};

/// Projects Gaussians to n splats, n_copies(v.view) of each, writes splats [n] at the indices of the visible ones,
/// entries and runs, and adds to the state's counters.instances, .visible and .runs. Of pinholes, skips chunks of
/// compact attributes outside the view before reading attributes. What exceeds a capacity is counted, not written;
/// large Gaussians that exceed theirs are not visible and have no entries. v.grid has tiles of kTurboTile. Of
/// PagedAttributes, projects the rows of `drawn`, which are in view already; n is the capacity of their splats. Errors:
/// device_failed.
struct TurboEmitArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  ScreenSplat* splats;
  TurboArrays arrays;
  DrawnChunks drawn = {};
  std::optional<bool> in_pairs = {};  ///< of pinholes without levels: two Gaussians a thread; if absent, of millions
};
Status launch_turbo_emit(const TurboEmitArguments& arguments, Stream stream);

/// Writes the entries and runs of the large Gaussians that launch_turbo_emit() has set aside, which calls it. Errors:
/// device_failed.
Status launch_turbo_large_gaussians(const TurboArrays& arrays, math::TileGrid grid, Stream stream);

/// Makes every tile's list and rank, and the cells of empty ones. If a capacity was exceeded, all lists are empty.
/// Copies the state to `seen`, page-locked memory that the device reaches. Errors: device_failed.
Status launch_turbo_lists(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, Stream stream);

/// Orders the lists that are not long by depth, then by index, and deals them out to their tiles' cells. Cells of
/// tiles that do not fit are empty. `seen`, as above, gets the Gaussians of all cells once both this and
/// launch_turbo_long_lists() have placed theirs. `is_sparse`: the frame before had few tiles with lists; this one may
/// have any number. Errors: device_failed.
Status launch_turbo_order(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, bool is_sparse,
                          Stream stream);

/// The same for the long lists; both may run side by side. Moves them to scratch memory, cut into units. Errors:
/// device_failed.
Status launch_turbo_long_lists(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, Stream stream);
/// Then orders the units. Errors: device_failed.
Status launch_turbo_units(const TurboArrays& arrays, Stream stream);

struct TurboBlendArguments {
  TurboArrays arrays;
  const ScreenSplat* splats;
  math::TileGrid grid;  ///< of tiles of kTurboTile
  int width, height;    ///< px
  math::Vec3<float> background;
  PixelArrays target;
  bool count_pairs;  ///< add to the state's counters.evaluated and .blended
  bool is_filled;    ///< launch_turbo_fill() has written tiles without Gaussians

  bool has_details() const {
    return target.depth != nullptr || target.evaluated != nullptr || target.blended != nullptr || count_pairs;
  }
};
/// Blends each cell in FP32. Errors: device_failed.
Status launch_turbo_blend(const TurboBlendArguments& arguments, Stream stream);

/// Writes to all pixels what a pixel without Gaussians shows; without details. Errors: device_failed.
Status launch_turbo_fill(const TurboBlendArguments& arguments, Stream stream);

/// launch_turbo_blend() by FP16 matrix products, without details. First the cells of lists that are not long, once
/// these are ordered, and the cells of long lists, once their units are; both may run side by side. Errors:
/// device_failed.
Status launch_turbo_tensor(const TurboBlendArguments& arguments, Stream stream);
Status launch_turbo_tensor_long(const TurboBlendArguments& arguments, Stream stream);
/// Then the rest of the long cells. Errors: device_failed.
Status launch_turbo_segments(const TurboBlendArguments& arguments, Stream stream);

}  // namespace rgs::cuda
