// tile_blend.hpp - the inner loop's interface: one tile's list of Gaussians to its pixels, in two implementations.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "rgs/math/blend.hpp"
#include "rgs/math/coverage.hpp"

namespace rgs::detail {

inline constexpr int kTilePixels = math::kTileSize * math::kTileSize;

/// What blending needs of a Gaussian on the image; one cache line.
struct alignas(64) ScreenSplat {
  math::PixelPoint<float> mean;  // px
  math::Conic<float> conic;
  float opacity;
  float cutoff;  // power_cutoff(opacity)
  float log2_opacity;
  float z;
  math::Vec3<float> color;
  std::uint32_t spans;  // first of n_rows tile spans, in its block's list
  std::uint16_t first_row, n_rows;
  std::uint32_t gaussian;  // index in the scene
};
static_assert(sizeof(ScreenSplat) == 64);

/// What a Gaussian gave to a tile's pixels: alpha T, the weight of its colour.
struct TileWeight {
  float sum = 0, largest = 0;
};

/// One tile's work: `list` holds indices into `splats`, front to back.
struct TileJob {
  std::span<const std::uint32_t> list;
  const ScreenSplat* splats;
  int x, y;           // first pixel
  int width, height;  // pixels inside the image, 1..16 each
  math::Exponent exponent;
  math::Exp exp;
  bool details;         // depth, blended or weights are wanted; otherwise the pixels' may stay unset
  TileWeight* weights;  // [list.size()], zero at first, or null: not wanted
};

/// Pixels of a tile, row by row, 16 apart; those outside the image are unspecified.
struct alignas(64) TilePixels {
  float r[kTilePixels], g[kTilePixels], b[kTilePixels], depth[kTilePixels], transmittance[kTilePixels];
  std::uint32_t evaluated[kTilePixels], blended[kTilePixels];
};

/// The definition: rgs::math pixel by pixel. Returns the number of pairs that were blended.
std::uint64_t blend_tile_scalar(const TileJob& job, TilePixels& pixels);

/// The same in the widest vectors that the machine has. Rows and vectors without a pair that counts are passed over;
/// results differ from the definition by the rounding of the exponent.
std::uint64_t blend_tile_simd(const TileJob& job, TilePixels& pixels);
/// Name of the instruction set in use, static text.
const char* simd_target_name();

}  // namespace rgs::detail
