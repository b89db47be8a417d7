// frame.hpp - what the stages of a frame exchange. All pointers are device pointers.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/math/blend.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/options.hpp"
#include "rgs/math/pixel_format.hpp"

struct CUstream_st;

namespace rgs::cuda {

/// cudaStream_t, without the toolkit's headers.
using Stream = CUstream_st*;

/// A view and the arithmetic of its projection.
struct ViewParameters {
  math::View<float> view;
  math::TileGrid grid;
  float low_pass;  ///< px^2
  math::AntiAliasing anti_aliasing;
  int sh_degree;  ///< evaluated; at most the stored one
  math::DepthQuantizer quantizer;
  math::KeyLayout key;
};

/// A projected Gaussian: three 128-bit words.
struct alignas(16) ScreenSplat {
  math::PixelPoint<float> mean;  ///< px
  math::Conic<float> conic;
  float log2_opacity;  ///< after conic.c, so that turbo_tensor.cu loads both at once
  float opacity;
  float z;  ///< camera depth
  math::Vec3<float> color;
  float cutoff;  ///< math::power_cutoff(opacity)
};
static_assert(sizeof(ScreenSplat) == 48);

/// Counters of a frame, zeroed before it.
struct Counters {
  std::uint64_t instances;  ///< (tile, Gaussian) pairs, also those that did not fit
  std::uint64_t visible;    ///< splats in at least one tile
  std::uint64_t evaluated;  ///< (pixel, Gaussian) pairs; counted on request
  std::uint64_t blended;    ///< the same
};

/// Pairs of a tile: sorted instances begin .. end - 1.
struct TileRange {
  std::uint32_t begin, end;
};

/// Outputs [height, width(, 3)], rows from top to bottom, contiguous; null: not wanted.
struct TightArrays {
  float* rgb = nullptr;
  float* alpha = nullptr;
  float* depth = nullptr;
  std::uint32_t* evaluated = nullptr;
  std::uint32_t* blended = nullptr;
  void* packed = nullptr;  ///< pixels of `format`, aligned to math::pixel_bytes() of it
  math::PixelFormat format = math::PixelFormat::rgba8;
  std::uint8_t* codes = nullptr;  ///< math::code8() of rgb
};

/// Bytes from one row to the next of each output; multiples of its element's size.
struct RowPitches {
  std::uint64_t rgb = 0, alpha = 0, depth = 0, evaluated = 0, blended = 0, packed = 0, codes = 0;

  bool operator==(const RowPitches&) const = default;
};

/// The same with padded rows, or on a surface.
struct PixelArrays : TightArrays {
  std::uint64_t surface = 0;  ///< cudaSurfaceObject_t that takes the packed pixels instead of `packed`; 0 = none
  RowPitches pitch = {};      ///< kernels need all of them: with_pitches()

  /// The same with every pitch 0 replaced by that of contiguous rows of `width` pixels.
  PixelArrays with_pitches(int width) const {
    PixelArrays a = *this;
    const auto w = static_cast<std::uint64_t>(width);
    const auto fill = [](std::uint64_t& p, std::uint64_t row_bytes) { p = p == 0 ? row_bytes : p; };
    fill(a.pitch.rgb, w * 3 * sizeof(float));
    fill(a.pitch.alpha, w * sizeof(float));
    fill(a.pitch.depth, w * sizeof(float));
    fill(a.pitch.evaluated, w * sizeof(std::uint32_t));
    fill(a.pitch.blended, w * sizeof(std::uint32_t));
    fill(a.pitch.packed, w * math::pixel_bytes(format));
    fill(a.pitch.codes, w * 3);
    return a;
  }
  /// Whether every output has contiguous rows of `width` pixels and none is a surface.
  bool is_tight(int width) const {
    PixelArrays tight = *this;
    tight.pitch = {};
    return surface == 0 && pitch == tight.with_pitches(width).pitch;
  }
};

}  // namespace rgs::cuda
