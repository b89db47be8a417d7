// turbo.hpp - launches of the turbo pipeline: lists per tile, each ordered on its own and dealt out to the cells that are
// blended. No sort over the frame, and nothing that the host must know before the last kernel is queued. README.md has the
// words, turbo_geometry.hpp the sizes of tiles and cells.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/cut.hpp"
#include "common/frame.hpp"
#include "common/tie_order.hpp"
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

/// Entries begin .. begin + n - 1 of one tile, written by one block.
struct TurboRun {
  std::uint32_t begin, n;
};
/// A run on its way to its tile.
struct alignas(16) TurboTileRun {
  TurboRun run;
  std::uint32_t tile;
  std::uint32_t in_tile;  ///< place among the tile's runs
};
static_assert(sizeof(TurboTileRun) == 16);

/// A tile's list: runs begin .. begin + n_runs - 1, with n_entries in all. `number` is its place among the long lists, if it
/// is one: if it has kTurboRound or more; among those of its class otherwise.
struct TurboList {
  std::uint32_t begin, n_runs, n_entries, number;
};
inline constexpr std::uint32_t kTurboRound = 2048;  ///< that a block orders at a time; a power of two
/// The same of a rank.
struct alignas(16) TurboRankedList {
  std::uint32_t begin, n_runs, n_entries, tile;
};

/// What a cell shows: Gaussians begin .. begin + n - 1 of TurboArrays::cell_gaussians, in order.
struct alignas(16) TurboCell {
  std::uint32_t begin, n;
  std::uint32_t x, y;  ///< its first pixel
};
static_assert(sizeof(TurboCell) == 16);

/// A Gaussian whose bounding box has many tiles: kept for a kernel in which tiles look for theirs.
struct alignas(16) TurboLargeGaussian {
  math::Ellipse<float> ellipse;
  std::uint32_t depth;  ///< bits
  std::uint32_t index;
  std::uint32_t listed;  ///< 1 once it has an entry
  std::uint32_t unused[4];
};
static_assert(sizeof(TurboLargeGaussian) == 64);
/// Its bounding box: tiles x0 <= x < x1, y0 <= y < y1.
struct alignas(8) TurboBox {
  std::uint16_t x0, y0, x1, y1;
};

/// A long list is moved to scratch memory in the order of kTurboBins bins of depth, slice by slice, and cut in parts, bins
/// next to each other. It is then ordered in units: parts, or a share of one that holds more than is ordered at a time.
struct alignas(16) TurboLongList {
  std::uint32_t tile;
  std::uint32_t in_class;               ///< place of the tile in its class, see below
  std::uint32_t scratch;                ///< place of its n_entries in TurboArrays::scratch
  std::uint32_t first_slice, n_slices;  ///< in turn, a slice has ceil(n_runs / n_slices) of its runs
  std::uint32_t nearest, farthest;      ///< bits of depth: range of a sample of the entries
  std::uint32_t counted;                ///< slices that have been
  std::uint32_t n_entries;
  std::uint32_t first_unit;               ///< its units have numbers in order of depth
  std::uint32_t cell_n[kTurboCells];      ///< Gaussians of its cells,
  std::uint32_t cell_begin[kTurboCells];  ///< and where they begin in TurboArrays::cell_gaussians
};
inline constexpr std::uint32_t kTurboBins = 1024;
inline constexpr std::uint32_t kTurboSlice = 1024;  ///< entries of a list's slices on average, or more
/// The same of a list of n in a frame of so many entries: short slices where they are few, for all blocks shall have some;
/// longer ones of a long list, for they add to the same bins.
RGS_HD constexpr std::uint32_t turbo_slice(std::uint64_t entries, std::uint32_t n) {
  return static_cast<std::uint32_t>(math::clamp(math::max(entries / 2048, std::uint64_t{n / 16}),
                                                std::uint64_t{kTurboSlice}, std::uint64_t{4 * kTurboSlice}));
}
inline constexpr std::uint32_t kTurboSliceRuns = 256;  ///< runs of a slice, or fewer
inline constexpr std::uint32_t kTurboPart = 1024;      ///< entries of a part, but for the length of a bin
inline constexpr std::uint32_t kTurboShare = 1024;     ///< entries of a share, but for what a sample misses

/// Entries of lists so long have ranks in scratch memory: parts of many shares are read many times.
inline constexpr std::uint32_t kTurboRankedList = 1u << 16;
RGS_HD constexpr bool has_ranks_in_scratch(const TieOrder& ties, const TurboLongList& list) {
  return ties.rank != nullptr && list.n_entries >= kTurboRankedList;
}

/// Of the part begin .. end - 1 of TurboArrays::scratch: all entries, or one share of more than kTurboRound.
struct alignas(16) TurboUnit {
  std::uint32_t begin, end;
  std::uint32_t long_list;
  std::uint32_t share;
};
/// How many units order a part of n entries.
RGS_HD constexpr std::uint32_t turbo_shares(std::uint32_t n) {
  if (n <= kTurboRound) return 1;
  const std::uint32_t shares = (n + kTurboShare - 1) / kTurboShare;
  return shares < kTurboRound / 2 ? shares : kTurboRound / 2;
}

/// A cell of more Gaussians than a block blends: what is left after the front, if any transmittance is, is blended in
/// segments side by side, each as if nothing lay before it. Transmittance is associative: two segments become one, and that
/// goes behind what lies before it once this is there. Segments come in waves of 1, 2, 4, ...: when one is begun, it is mostly
/// known whether those before have left any transmittance.
struct alignas(16) TurboLongCell {
  std::uint32_t cell;           ///< of TurboArrays::cells
  std::uint32_t front;          ///< Gaussians before the first segment
  std::uint32_t n_segments;     ///< 1 or more
  std::uint32_t segment_n;      ///< Gaussians of a segment, fewer in the last
  std::uint32_t first_segment;  ///< of TurboArrays::segment_pixels and segment_done
  std::uint32_t waves_done;     ///< a bit each
  std::uint32_t lock;           ///< 1 while a block puts waves behind each other
  std::uint32_t n_joined;       ///< waves that are, in turn
  std::uint32_t is_opaque;      ///< nothing that comes after them shows; 1 also once all are joined
  std::uint32_t unused[3];
};
inline constexpr std::uint32_t kTurboSegment =
    RGS_TURBO_SEGMENT;  ///< Gaussians of a segment, or more where there are many
inline constexpr std::uint32_t kTurboWaves = 10;
inline constexpr std::uint32_t kTurboMaxSegments = (1u << kTurboWaves) - 1;  ///< of a cell
/// Gaussians of a cell that its own block blends, of a frame with so many entries: as many as keep all blocks of a large device
/// busy, for segments cost more.
RGS_HD constexpr std::uint32_t turbo_front(std::uint64_t entries) {
  const std::uint64_t share = entries / RGS_TURBO_FRONT_SHARE / kTurboSegment * kTurboSegment;
  return share > kTurboSegment ? static_cast<std::uint32_t>(share) : kTurboSegment;
}
struct TurboSegment {
  std::uint32_t long_cell, in_cell;
};
/// What a segment adds to a pixel, and what it lets through.
struct alignas(16) TurboPixel {
  float r, g, b, transmittance;
};
static_assert(kTurboSegment % 128 == 0);

/// Tiles by classes of list length, the longest first: they start first, so that none is left running alone at the end.
inline constexpr int kTurboClasses = 32;
/// Two classes for each power of two from 2^5; 0 is the longest, the last but one the shortest, the last holds the empty.
RGS_HD constexpr int turbo_class(std::uint32_t length) {
  if (length < 32) return length == 0 ? kTurboClasses - 1 : kTurboClasses - 2;
  int log2 = 5;
  while (length >> (log2 + 1) != 0) ++log2;
  const int half = static_cast<int>(length >> (log2 - 1)) & 1;
  const int longer = 2 * (log2 - 5) + half;
  return longer < kTurboClasses - 3 ? kTurboClasses - 3 - longer : 0;
}
static_assert(turbo_class(kTurboRound) < turbo_class(kTurboRound - 1), "long lists have the first ranks");

/// A frame whose runs are not more than these is sparse: most of its tiles are empty, and blocks of their own would cost more
/// than all else.
RGS_HD constexpr std::uint32_t sparse_tiles(std::uint32_t n_tiles) {
  return n_tiles / 8 + 1;
}

/// Device state of a frame, zeroed before it. Arrays [tiles] follow it in the same memory: see TurboState::bytes().
struct TurboState {
  Counters counters;
  std::uint64_t runs;               ///< written or not
  std::uint32_t n_large_gaussians;  ///< the same of TurboArrays::large_gaussians
  std::uint32_t n_placed;           ///< runs that have a place in their tile's list
  std::uint32_t n_scratch;          ///< entries of the long lists
  std::uint32_t n_ordered;          ///< tiles whose cells have their places
  std::uint32_t n_long_lists, n_slices, n_units;
  std::uint32_t n_taken;   ///< units that a block has begun
  std::uint64_t in_cells;  ///< Gaussians of all cells, written or not
  std::uint32_t n_long_cells, n_segments;
  std::uint32_t n_segments_taken;    ///< that a block has begun
  std::uint32_t n_long_cells_taken;  ///< of the long lists' cells, the same
  std::uint32_t unused[2];
  std::uint32_t wave_size[kTurboWaves];
  std::uint32_t class_size[kTurboClasses];

  /// With a TurboCount of each tile.
  static std::uint64_t bytes(std::uint32_t n_tiles) { return sizeof(TurboState) + 8 * std::uint64_t{n_tiles}; }
};
/// Entries of a tile; its runs << 32.
using TurboCount = std::uint64_t;
static_assert(sizeof(TurboState) % 16 == 0);

/// Where the front end leaves entries, and the lists made of them.
struct TurboArrays {
  TurboState* state;
  std::uint32_t n_tiles;
  TurboEntry* entries;                  ///< [entry_capacity]
  TurboTileRun* runs;                   ///< [run_capacity]
  TurboRun* tile_runs;                  ///< [run_capacity] the same by tile
  TurboLargeGaussian* large_gaussians;  ///< [large_capacity]
  TurboBox* large_boxes;                ///< [large_capacity]
  TurboEntry* scratch;                  ///< [entry_capacity] of the long lists
  TurboLongList* long_lists;            ///< [TurboLongListSizes::lists], and so on
  TurboUnit* units;
  std::uint32_t* unit_cells;      ///< [units, kTurboCells] entries that touch each cell, and 1; 0 while not known
  std::uint32_t* bins;            ///< [lists, kTurboBins] entries of each bin; then the place of its next one
  std::uint32_t* slices;          ///< lists of the slices
  TurboList* lists;               ///< [n_tiles]
  TurboRankedList* ranked;        ///< [n_tiles] in the order of their classes
  TurboCell* cells;               ///< [n_tiles, kTurboCells] the same
  std::uint32_t* cell_gaussians;  ///< [cell_capacity]
  TurboLongCell* long_cells;      ///< [TurboLongCellSizes::cells]
  TurboPixel* long_cell_pixels;   ///< [cells, pixels of a cell] colour and transmittance of what is joined
  TurboPixel* segment_pixels;     ///< [segments, pixels of a cell] of a segment alone
  std::uint32_t* segment_done;    ///< [segments]
  TurboSegment* waves;            ///< [kTurboWaves, segments]
  std::uint64_t entry_capacity, run_capacity, large_capacity, cell_capacity;
  TieOrder ties;  ///< of the scene's Gaussians; without one, equal depths are ordered by index
  /// Or, with wants_ranks, by the values of drawn rows, which indices then are. *wants_ranks, page-locked memory that the device
  /// reaches, becomes 1 where more of a tile are equal than are ordered at a time: the frame is then wrong, and has to be drawn with `ties`.
  ChosenRows rows;
  std::uint32_t* wants_ranks;
};

/// How many long cells and segments there can be at most among so many Gaussians of cells.
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
  /// One after the other in `memory`, of so many bytes.
  void lay_out(void* memory, TurboArrays& to) const {
    if (memory == nullptr) return;
    to.long_cells = static_cast<TurboLongCell*>(memory);
    to.long_cell_pixels = reinterpret_cast<TurboPixel*>(to.long_cells + cells);
    to.segment_pixels = to.long_cell_pixels + cells * kPixels;
    to.waves = reinterpret_cast<TurboSegment*>(to.segment_pixels + segments * kPixels);
    to.segment_done = reinterpret_cast<std::uint32_t*>(to.waves + kTurboWaves * segments);
  }
};

/// How many long lists, and parts of them, there can be at most among so many entries and runs.
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
  /// One after the other in `memory`, of so many bytes.
  void lay_out(void* memory, TurboArrays& to) const {
    if (memory == nullptr) return;
    to.long_lists = static_cast<TurboLongList*>(memory);
    to.units = reinterpret_cast<TurboUnit*>(to.long_lists + lists);
    to.bins = reinterpret_cast<std::uint32_t*>(to.units + units);  // aligned to 16 bytes: four at a time
    to.unit_cells = to.bins + lists * kTurboBins;
    to.slices = to.unit_cells + units * kTurboCells;
  }
};

/// Projects n Gaussians, writes splats [n] at the indices of the visible ones, entries and runs; adds to the state's
/// counters.instances, .visible and .runs. Chunks of compact attributes outside the view are passed over before an
/// attribute is read. What exceeds a capacity is counted, not written; large Gaussians that exceed theirs are not visible
/// and have no entries. v.grid is that of tiles of kTurboTile. n < kMaxTurboGaussians. Of PagedAttributes the rows of `drawn`
/// are projected, and have the indices of drawn rows; n is room for them. Its chunks are not compared with the view again. Errors: device_failed.
struct TurboEmitArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  ScreenSplat* splats;
  TurboArrays arrays;
  DrawnChunks drawn = {};
};
Status launch_turbo_emit(const TurboEmitArguments& arguments, Stream stream);

/// Writes the entries and runs of the large Gaussians. launch_turbo_emit(), which has set them aside, calls it.
/// Errors: device_failed.
Status launch_turbo_large_gaussians(const TurboArrays& arrays, math::TileGrid grid, Stream stream);

/// Gives every tile its runs and its rank; the cells of empty ones. If a capacity was exceeded, all lists are empty. `seen`
/// gets a copy of the state for the host to read: page-locked memory that the device reaches. Errors: device_failed.
Status launch_turbo_lists(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, Stream stream);

/// Orders the lists that are not long by depth, then in tie order, and deals them out to their tiles' cells. Cells of tiles
/// that do not fit are empty. `seen`, see above, gets the Gaussians of all cells once both this and
/// launch_turbo_long_lists() have found places for theirs. Errors: device_failed.
/// `is_sparse`: few tiles have lists, says the frame before; this one's may have any number.
Status launch_turbo_order(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, bool is_sparse,
                          Stream stream);

/// The same for the long lists; the two may run side by side. Moves them to scratch memory, cut in units. Errors:
/// device_failed.
Status launch_turbo_long_lists(const TurboArrays& arrays, math::TileGrid grid, TurboState* seen, Stream stream);
/// Then this orders the units. Errors: device_failed.
Status launch_turbo_units(const TurboArrays& arrays, Stream stream);

struct TurboBlendArguments {
  TurboArrays arrays;
  const ScreenSplat* splats;
  math::TileGrid grid;  ///< of tiles of kTurboTile
  int width, height;    ///< px
  math::Vec3<float> background;
  PixelArrays target;
  bool count_pairs;  ///< into the state's counters.evaluated and .blended
  bool is_filled;    ///< with what tiles without Gaussians show, by launch_turbo_fill()

  bool has_details() const {
    return target.depth != nullptr || target.evaluated != nullptr || target.blended != nullptr || count_pairs;
  }
};
/// Blends each cell in FP32. Errors: device_failed.
Status launch_turbo_blend(const TurboBlendArguments& arguments, Stream stream);

/// Writes to all pixels what shows where no Gaussian is; without details. Errors: device_failed.
Status launch_turbo_fill(const TurboBlendArguments& arguments, Stream stream);

/// The same as launch_turbo_blend() by FP16 matrix products, without details. The cells of the lists that are not long, once they are ordered; those of
/// the long lists, once their units are: the two may run side by side. Errors: device_failed.
Status launch_turbo_tensor(const TurboBlendArguments& arguments, Stream stream);
Status launch_turbo_tensor_long(const TurboBlendArguments& arguments, Stream stream);
/// Then what both have left of long cells. Errors: device_failed.
Status launch_turbo_segments(const TurboBlendArguments& arguments, Stream stream);

}  // namespace rgs::cuda
