// turbo_geometry.hpp - turbo's tiles and cells: their sizes, which cells an ellipse touches, and the words that hold
// them.
// SPDX-License-Identifier: Apache-2.0
//
// A build with other sizes defines these macros; derived constants follow, and static_asserts reject what does not
// work:
//
//   tile 32   cells of 16x8 (8 a tile), 16x16 (4), 16x32 (2)
//   tile 16   cells of 16x4 (4 a tile), 16x8 (2), 16x16 (1)
//   tile 64   cells of 16x32 (8 a tile)
//
// Only 16x8 on 32 was measured. Widths of 8 and 32 compile, too.
#pragma once

#include <bit>
#include <cstdint>
#include <type_traits>

#include "rgs/hd.hpp"
#include "rgs/math/blend.hpp"
#include "rgs/math/coverage.hpp"

#ifndef RGS_TURBO_TILE
#define RGS_TURBO_TILE 32
#endif
#ifndef RGS_TURBO_CELL_WIDTH
#define RGS_TURBO_CELL_WIDTH 16
#endif
#ifndef RGS_TURBO_CELL_HEIGHT
#define RGS_TURBO_CELL_HEIGHT 8
#endif

namespace rgs::cuda {

inline constexpr int kTurboTile = RGS_TURBO_TILE;  ///< pixels along a tile's side
inline constexpr int kTurboCellWidth = RGS_TURBO_CELL_WIDTH, kTurboCellHeight = RGS_TURBO_CELL_HEIGHT;  ///< px
inline constexpr int kTurboCellColumns = kTurboTile / kTurboCellWidth, kTurboCellRows = kTurboTile / kTurboCellHeight;
inline constexpr int kTurboCells = kTurboCellColumns * kTurboCellRows;  ///< of a tile, numbered row by row

static_assert(std::has_single_bit(unsigned{kTurboTile}) && std::has_single_bit(unsigned{kTurboCellWidth}) &&
                  std::has_single_bit(unsigned{kTurboCellHeight}),
              "quotients by them are shifts, and products with their inverses exact");
static_assert(kTurboCellWidth <= kTurboTile && kTurboCellHeight <= kTurboTile, "cells fill a tile");

/// A Gaussian in a list: its depth (turbo_depth()), its index, and a bit for each cell of the tile that it touches.
/// Entries order by depth, then by index. Indices of more Gaussians than kTurboIndexBits number take the last bits of
/// depths, `dropped` (turbo_dropped_bits()).
using TurboEntry = std::uint64_t;
inline constexpr int kTurboDepthBits = 29, kTurboIndexBits = 27, kTurboCellBits = 8;
static_assert(kTurboDepthBits + kTurboIndexBits + kTurboCellBits == 64,
              "an entry is one word, loaded and ordered as one");
static_assert(kTurboCells <= kTurboCellBits, "an entry has a bit for each cell: larger cells or smaller tiles");

/// Of 0 < n <= 2^31 splats; at most 4.
RGS_HD constexpr int turbo_dropped_bits(std::uint32_t n) {
  int bits = 0;
  while ((n - 1) >> (kTurboIndexBits + bits) != 0) ++bits;
  return bits;
}

/// Steps of FP32 from the near plane, or from 2^-24 if that is farther, to depth z: exact up to 2^64 times that depth
/// and equal beyond.
RGS_HD inline std::uint32_t turbo_depth(float z, float near_plane) {
  constexpr float kNearest = 0x1p-24F;
  const std::uint32_t steps =
      math::depth_bits(math::max(z, kNearest)) - math::depth_bits(math::max(near_plane, kNearest));
  return math::min(steps, (1u << kTurboDepthBits) - 1);
}

// The upper word has all of the depth and the index's first bits.
inline constexpr int kTurboIndexAbove = kTurboIndexBits + kTurboCellBits - 32;
static_assert(kTurboIndexAbove > 0);
RGS_HD constexpr TurboEntry make_entry(std::uint32_t depth, std::uint32_t index, std::uint32_t cells, int dropped = 0) {
  return TurboEntry{depth >> dropped << (kTurboIndexAbove + dropped)} << 32 | TurboEntry{index} << kTurboCellBits |
         cells;
}
/// Without the dropped bits.
RGS_HD constexpr std::uint32_t depth_of(TurboEntry entry, int dropped = 0) {
  return static_cast<std::uint32_t>(entry >> 32) >> (kTurboIndexAbove + dropped);
}
RGS_HD constexpr std::uint32_t index_of(TurboEntry entry, int dropped = 0) {
  return static_cast<std::uint32_t>(entry >> kTurboCellBits) & ((1u << (kTurboIndexBits + dropped)) - 1);
}
RGS_HD constexpr bool touches(TurboEntry entry, std::uint32_t cell) {
  return (static_cast<std::uint32_t>(entry) >> cell & 1) != 0;
}
static_assert(depth_of(make_entry(0x1FFFFFFF, 5, 7)) == 0x1FFFFFFF &&
              index_of(make_entry(1, 0x7FFFFFF, 255)) == 0x7FFFFFF);
static_assert(depth_of(make_entry(0x1FFFFFFF, 5, 7, 4), 4) == 0x1FFFFFF &&
              index_of(make_entry(31, 0x7FFFFFFE, 255, 4), 4) == 0x7FFFFFFE);

/// A strip: neighbouring tiles of a row whose cells fill one word, a byte for each row of cells. Bit c of byte r is the
/// c-th cell of row r from the strip's first tile.
inline constexpr int kTurboStripCells = 8;  ///< of a row
inline constexpr int kTurboStripTiles = kTurboStripCells / kTurboCellColumns;
static_assert(kTurboCellRows <= 4,
              "a strip is a word with a byte for each row of cells: higher cells or smaller tiles");

namespace detail {

/// Sum of 1 << (first + step k) for k = 0 .. n - 1.
constexpr std::uint64_t bits_at(int first, int step, int n) {
  std::uint64_t bits = 0;
  for (int k = 0; k < n; ++k) bits |= std::uint64_t{1} << (first + step * k);
  return bits;
}

// 1 << n, where n is 8 x clamped to 0..8 and rounded up or down; 1 for NaN. The device rounds by adding 2^20, whose
// last bit is 1/8, and shifts by the sum's last bits: all but the shift runs on the arithmetic pipe, which has room.
template <bool Up, class T>
RGS_HD inline std::uint32_t bit_of_eighth(T x) {
  static_assert(kTurboStripCells == 8, "2^20 is the float with this last bit");
#if defined(__CUDA_ARCH__)
  if constexpr (std::is_same_v<T, float>) {
    const float unit = __saturatef(x), sum = Up ? __fadd_ru(unit, 1048576.0F) : __fadd_rd(unit, 1048576.0F);
    return __funnelshift_l(0u, 1u, __float_as_uint(sum));
  }
#endif
  const T eighths = T(kTurboStripCells) * math::clamp(x, T(0), T(1));
  return 1u << (Up ? math::detail::ceil_index(eighths) : math::detail::floor_index(eighths));
}

}  // namespace detail

/// A bit in each row of cells of a strip.
inline constexpr auto kTurboStripRows =
    static_cast<std::uint32_t>(detail::bits_at(0, kTurboStripCells, kTurboCellRows));

/// The ellipse's first and last cell in each row of cells of a row of tiles, from the image's left edge, in units of a
/// strip. With c = 8 x, these are the cells ceil(c_first) <= c < floor(c_last); both are 0 if there is none.
template <class T>
struct CellRows {
  T first[kTurboCellRows], last[kTurboCellRows];
};

/// Cells of tile row `row` in which the ellipse has a point between their outermost pixel centres; as exact as
/// math::tiles_in_row(). Without branches, since of 32 neighbouring Gaussians one always touches a row.
template <class T>
RGS_HD inline CellRows<T> cell_rows(const math::Ellipse<T>& e, int row) {
  constexpr T kUnit = T(1) / T(kTurboStripCells * kTurboCellWidth);
  const T slack = T(1e-3) + T(1e-6) * e.half_width;  // as in math::tiles_in_row()
  // Cells first <= c < last of width w: w c + w - 1 reaches the left end, and w (c + 1) is beyond the right one.
  const T left = e.mean.u - slack - T(kTurboCellWidth - 1), right = e.mean.u + slack + T(kTurboCellWidth);
  const T top = static_cast<T>(row * kTurboTile) - e.mean.v;
  CellRows<T> rows;
  for (int r = 0; r < kTurboCellRows; ++r) {
    const T y_low = math::max(top + T(kTurboCellHeight * r), -e.half_height);
    const T y_high = math::min(top + T(kTurboCellHeight * r + kTurboCellHeight - 1), e.half_height);
    const math::Chord<T> c = math::chord(e, y_low, y_high);
    const bool some = y_low <= y_high;
    rows.first[r] = some ? (left + c.low) * kUnit : T(0);
    rows.last[r] = some ? (right + c.high) * kUnit : T(0);
  }
  return rows;
}

/// Touched cells of the strip that starts at tile column `column`.
template <class T>
RGS_HD inline std::uint32_t cells_of_strip(const CellRows<T>& rows, int column) {
  const T origin = T(1) / T(kTurboStripTiles) * static_cast<T>(column);
  std::uint32_t cells = 0;
  for (int r = 0; r < kTurboCellRows; ++r) {
    const std::uint32_t below_last = detail::bit_of_eighth<false>(rows.last[r] - origin);
    cells |= (below_last - detail::bit_of_eighth<true>(rows.first[r] - origin)) << (kTurboStripCells * r);
  }
  return cells;
}

/// Of these, the cells of tile `tile` of the strip, as in an entry: bit c + columns r for the cell in column c of row
/// r.
RGS_HD constexpr std::uint32_t cells_in_strip(std::uint32_t strip, int tile) {
  constexpr std::uint32_t kFirstTile = ((1u << kTurboCellColumns) - 1) * kTurboStripRows;
  // Gathers the first tile's rows in the product's last byte.
  constexpr auto kGather =
      static_cast<std::uint32_t>(detail::bits_at(24, kTurboCellColumns - kTurboStripCells, kTurboCellRows));
  return (strip >> (kTurboCellColumns * tile) & kFirstTile) * kGather >> 24;
}
static_assert(
    [] {
      for (std::uint32_t cells = 0; cells < 1u << kTurboCells; ++cells) {
        std::uint32_t strip = 0;
        for (int r = 0; r < kTurboCellRows; ++r) {
          strip |= (cells >> (kTurboCellColumns * r) & ((1u << kTurboCellColumns) - 1)) << (kTurboStripCells * r);
        }
        if (cells_in_strip(strip, 0) != cells) return false;
      }
      return true;
    }(),
    "the product's other terms meet neither the last byte nor carry into it");

/// Touched cells of the tile in column `column`.
template <class T>
RGS_HD inline std::uint32_t cells_of_tile(const CellRows<T>& rows, int column) {
  return cells_in_strip(cells_of_strip(rows, column), 0);
}

/// First pixel of a cell of a tile.
struct TurboCorner {
  std::uint32_t x, y;
};
RGS_HD constexpr TurboCorner cell_corner(math::TileGrid grid, std::uint32_t tile, std::uint32_t cell) {
  const auto columns = static_cast<std::uint32_t>(grid.columns);
  return {tile % columns * kTurboTile + kTurboCellWidth * (cell % kTurboCellColumns),
          tile / columns * kTurboTile + kTurboCellHeight * (cell / kTurboCellColumns)};
}

}  // namespace rgs::cuda
