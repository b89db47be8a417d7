// blend.hpp - launches of the last stage: blends sorted pairs into pixels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// `Arrays`: PixelArrays, or TightArrays where they suffice.
template <class Arrays>
struct BlendArgumentsFor {
  const TileRange* ranges;         ///< [n_tiles]
  const std::uint32_t* gaussians;  ///< sorted
  const ScreenSplat* splats;
  math::TileGrid grid;
  int width, height;  ///< px
  math::Vec3<float> background;
  Arrays target;
  Counters* counters;  ///< .evaluated and .blended; null: not counted
  math::Exponent exponent;
  math::Exp exp;
  int pixels_per_thread;  ///< 1, or 2: (x, y) and (x, y + 1)
};
using BlendArguments = BlendArgumentsFor<PixelArrays>;
/// Errors: device_failed.
Status launch_blend(const BlendArguments& arguments, Stream stream);

}  // namespace rgs::cuda
