// turbo_cell.cuh - what the kernels that blend a cell of 16x8 pixels share.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/cuda/turbo.hpp"

namespace rgs::cuda {

// Whether an opacity may exceed kAlphaMax in the cell, also by what rounding can add to the exponent: terms as large as
// these cancel in it, and they are large for needles.
__device__ inline bool may_exceed(const ScreenSplat& splat, float corner_x, float corner_y) {
  constexpr float kLog2AlphaMax = -0.0144996F;
  constexpr float kRounding = 4 * math::kLog2E * 6e-8F;
  const float dx = fabsf(splat.mean.u - corner_x) + math::kCellWidth, dy = fabsf(splat.mean.v - corner_y) + math::kCellHeight;
  const float terms = splat.conic.a * dx * dx + splat.conic.c * dy * dy;
  return !(splat.log2_opacity + kRounding * terms < kLog2AlphaMax);
}

__device__ inline void store_color(const PixelArrays& t, std::size_t i, const math::Pixel<float>& pixel,
                                   const math::Vec3<float>& background) {
  if (t.rgb != nullptr) {
    const auto color = math::resolve(pixel, background);
    t.rgb[3 * i] = color.x, t.rgb[3 * i + 1] = color.y, t.rgb[3 * i + 2] = color.z;
  }
  if (t.alpha != nullptr) t.alpha[i] = 1 - pixel.transmittance;
}

}  // namespace rgs::cuda
