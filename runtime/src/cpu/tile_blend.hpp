// tile_blend.hpp - the inner loop: blends a tile's list of Gaussians into its pixels, in two implementations.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "rgs/math/blend.hpp"
#include "rgs/math/coverage.hpp"

namespace rgs::detail {

inline constexpr int kTilePixels = math::kTileSize * math::kTileSize;

/// What blending needs of a projected Gaussian; one cache line.
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

/// A Gaussian's weight, alpha T, in a tile's pixels.
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
  bool details;         // depth, blended or weights are wanted; otherwise they may stay unset
  TileWeight* weights;  // [list.size()], zero at first, or null: not wanted
};

/// Pixels of a tile, row by row, stride 16; those outside the image are unspecified.
struct alignas(64) TilePixels {
  float r[kTilePixels], g[kTilePixels], b[kTilePixels], depth[kTilePixels], transmittance[kTilePixels];
  std::uint32_t evaluated[kTilePixels], blended[kTilePixels];
};

/// The definition: rgs::math pixel by pixel. Returns the number of blended pairs.
std::uint64_t blend_tile_scalar(const TileJob& job, TilePixels& pixels);

/// The same with the machine's widest vectors. Skips rows and vectors without a pair that counts; differs from the
/// definition by the exponent's rounding.
std::uint64_t blend_tile_simd(const TileJob& job, TilePixels& pixels);
/// Name of the instruction set in use; static text.
const char* simd_target_name();

}  // namespace rgs::detail
