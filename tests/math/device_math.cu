// device_math.cu - instantiates the quantiser and rgs::math in device code; compiling is the test.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/blend.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/math/pixel_format.hpp"
#include "rgs/math/projection.hpp"
#include "rgs/math/sh.hpp"
#include "rgs/quantize.hpp"

namespace rgs::math {

struct Codes {
  const float* mean;              // [3]
  const std::uint16_t* geometry;  // [8]
  const std::int8_t* sh;          // [48]
  float step;
};

__global__ void draw_pixel(View<float> view, Codes codes, TileGrid grid, Pixel<float>* pixel, std::uint32_t* key) {
  float r[4];
  dequantize_rotation(codes.geometry, r);
  const Vec3<float> mean{codes.mean[0], codes.mean[1], codes.mean[2]};
  const Vec3<float> scale{float_from_half(codes.geometry[4]), float_from_half(codes.geometry[5]),
                          float_from_half(codes.geometry[6])};
  const float opacity = float_from_half(codes.geometry[7]);
  const auto splat =
      project(view, mean, Quaternion<float>{r[0], r[1], r[2], r[3]}, scale, opacity, kLowPass, AntiAliasing::classic);
  const auto basis = sh_basis(3, Vec3<float>{0.F, 0.F, 1.F});
  const auto color = sh_color(3, basis, [&](int k) {
    return Vec3<float>{dequantize_sh(codes.sh[3 * k], codes.step), dequantize_sh(codes.sh[3 * k + 1], codes.step),
                       dequantize_sh(codes.sh[3 * k + 2], codes.step)};
  });
  const auto e = ellipse(splat.mean, splat.footprint, power_cutoff(opacity));
  const TileSpan span = tiles_in_row(e, bounding_tiles(e, grid).y0, grid);
  const auto quantizer = make_depth_quantizer(DepthMapping::linear, 32 - tile_bits(1024), 0.2F, 100.F);
  *key = quantize_depth(quantizer, splat.z) + static_cast<std::uint32_t>(span.last - span.first) +
         pack_rgba8(color, 1.F) + static_cast<std::uint32_t>(pack_rgba16f(color, 1.F));
  const float exact = alpha_direct<Exp::exact>(power(splat.footprint.conic, 1.F, 2.F), opacity, power_cutoff(opacity));
  const float fast =
      alpha_folded<Exp::paper>(folded_exponent(fold(splat.footprint.conic, splat.mean, std::log2(opacity)), 1.F, 2.F));
  blend(*pixel, max(exact, fast), color, splat.z);
}

}  // namespace rgs::math
