// blend_fixture.hpp - runs the blending kernels on given lists.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "device_fixture.hpp"
#include "sorted/blend.hpp"

namespace rgs::test {

/// Device pointers as in cuda::BlendArguments.
struct BlendInput {
  const cuda::TileRange* ranges;
  const std::uint32_t* gaussians;
  const cuda::ScreenSplat* splats;
  int width, height;
  math::Vec3<float> background;
};

/// Outputs in host memory; NaN or all ones where the kernel did not write.
struct DeviceFrame {
  std::vector<float> rgb, alpha, depth;
  std::vector<std::uint32_t> evaluated, blended;
  cuda::Counters counters{};
};

/// Outputs to pass to a launch.
inline constexpr int kColorAndAlpha = 1 | 2, kAllOutputs = 31;

/// With `details` all outputs and the counters, otherwise those of `wanted`: bit 0 rgb, 1 alpha, 2 depth, 3 evaluated,
/// 4 blended.
inline DeviceFrame blend_on_device(const BlendInput& input, math::Exponent exponent, math::Exp exp,
                                   int pixels_per_thread, bool details, int wanted = kColorAndAlpha) {
  if (details) wanted = kAllOutputs;
  const auto n = static_cast<std::size_t>(input.width) * static_cast<std::size_t>(input.height);
  const DeviceArray<float> rgb(3 * n), alpha(n), depth(n);
  const DeviceArray<std::uint32_t> evaluated(n), blended(n);
  DeviceArray<cuda::Counters> counters(1);
  counters.fill(0);
  const auto given = [wanted](int bit, auto* pointer) { return (wanted >> bit & 1) != 0 ? pointer : nullptr; };
  require_ok(
      cuda::launch_blend({input.ranges, input.gaussians, input.splats, math::tile_grid(input.width, input.height),
                          input.width, input.height, input.background,
                          cuda::PixelArrays{{given(0, rgb.data()), given(1, alpha.data()), given(2, depth.data()),
                                             given(3, evaluated.data()), given(4, blended.data())}}
                              .with_pitches(input.width),
                          details ? counters.data() : nullptr, exponent, exp, pixels_per_thread},
                         nullptr));
  return {rgb.download(),       alpha.download(),   depth.download(),
          evaluated.download(), blended.download(), counters.download()[0]};
}

/// A Gaussian on the image in the front ends' form.
inline cuda::ScreenSplat screen_splat(math::PixelPoint<float> mean, math::Conic<float> conic, float opacity,
                                      math::Vec3<float> color = {1, 1, 1}, float z = 1) {
  const float cutoff = math::power_cutoff(opacity);
  return {mean, conic, math::kLog2AlphaMin - math::kLog2E * cutoff, opacity, z, color, cutoff};
}

/// Conic of a Gaussian with these standard deviations (px), its major axis rotated by `angle` from u to v.
inline math::Conic<float> conic_of(double major, double minor, double angle) {
  const double c = std::cos(angle), s = std::sin(angle), a = 1 / (major * major), b = 1 / (minor * minor);
  return {static_cast<float>(a * c * c + b * s * s), static_cast<float>((a - b) * c * s),
          static_cast<float>(a * s * s + b * c * c)};
}

/// Splats that every tile of an image lists in the given order.
class HandMade {
 public:
  HandMade(std::span<const cuda::ScreenSplat> splats, int width, int height)
      : splats_(splats), width_(width), height_(height) {
    const auto grid = math::tile_grid(width, height);
    const std::vector<cuda::TileRange> ranges(static_cast<std::size_t>(grid.columns * grid.rows),
                                              {0, static_cast<std::uint32_t>(splats.size())});
    ranges_ = DeviceArray<cuda::TileRange>(std::span<const cuda::TileRange>(ranges));
    std::vector<std::uint32_t> gaussians(splats.size());
    for (std::size_t i = 0; i < gaussians.size(); ++i) gaussians[i] = static_cast<std::uint32_t>(i);
    gaussians_ = DeviceArray<std::uint32_t>(std::span<const std::uint32_t>(gaussians));
  }
  DeviceFrame blend(math::Exponent exponent, math::Exp exp, int pixels_per_thread, bool details) const {
    return blend_on_device(input(), exponent, exp, pixels_per_thread, details);
  }
  BlendInput input() const { return {ranges_.data(), gaussians_.data(), splats_.data(), width_, height_, {0, 0, 0}}; }

 private:
  DeviceArray<cuda::ScreenSplat> splats_;
  DeviceArray<cuda::TileRange> ranges_;
  DeviceArray<std::uint32_t> gaussians_;
  int width_, height_;
};

}  // namespace rgs::test
