// frame.hpp - what the stages of a frame hand to each other. Pointers are device pointers.
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

/// A Gaussian on the image: three 128-bit words.
struct alignas(16) ScreenSplat {
  math::PixelPoint<float> mean;  ///< px
  math::Conic<float> conic;
  float opacity;
  float log2_opacity;
  float z;  ///< camera depth
  math::Vec3<float> color;
  float cutoff;  ///< math::power_cutoff(opacity)
};
static_assert(sizeof(ScreenSplat) == 48);

/// Counters of a frame, zeroed before it.
struct Counters {
  std::uint64_t instances;  ///< (tile, Gaussian) pairs, also those that did not fit the arrays
  std::uint64_t visible;    ///< Gaussians in at least one tile
  std::uint64_t evaluated;  ///< (pixel, Gaussian) pairs; counted on request
  std::uint64_t blended;    ///< the same
};

/// Pairs of a tile: sorted instances begin .. end - 1.
struct TileRange {
  std::uint32_t begin, end;
};

/// Outputs [height, width(, 3)], rows from top to bottom; null where not wanted.
struct PixelArrays {
  float* rgb = nullptr;
  float* alpha = nullptr;
  float* depth = nullptr;
  std::uint32_t* evaluated = nullptr;
  std::uint32_t* blended = nullptr;
  void* packed = nullptr;  ///< pixels of `format`, aligned to math::pixel_bytes() of it
  math::PixelFormat format = math::PixelFormat::rgba8;
};

}  // namespace rgs::cuda
