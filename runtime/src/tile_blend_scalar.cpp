// tile_blend_scalar.cpp - the definition of a pixel, executed literally: each pixel walks its tile's list.
// SPDX-License-Identifier: Apache-2.0
#include "tile_blend.hpp"

namespace rgs::detail {
namespace {

using math::Exp;
using math::Exponent;

template <Exponent X, Exp E>
float pair_alpha(const ScreenSplat& s, const TileJob& job, int x, int y) {
  if constexpr (X == Exponent::direct) {
    const float dx = s.mean.u - static_cast<float>(job.x + x), dy = s.mean.v - static_cast<float>(job.y + y);
    return math::alpha_direct<E>(math::power(s.conic, dx, dy), s.opacity, s.cutoff);
  } else {
    const math::PixelPoint<float> local{s.mean.u - static_cast<float>(job.x), s.mean.v - static_cast<float>(job.y)};
    const auto folded = math::fold(s.conic, local, s.log2_opacity);
    return math::alpha_folded<E>(math::folded_exponent(folded, static_cast<float>(x), static_cast<float>(y)));
  }
}

template <Exponent X, Exp E>
void blend_tile(const TileJob& job, TilePixels& out) {
  for (int y = 0; y < job.height; ++y) {
    for (int x = 0; x < job.width; ++x) {
      math::Pixel<float> pixel;
      std::uint32_t n_evaluated = 0, n_blended = 0;
      for (const std::uint32_t index : job.list) {
        const ScreenSplat& s = job.splats[index];
        ++n_evaluated;
        const float alpha = pair_alpha<X, E>(s, job, x, y);
        if (alpha == 0) continue;
        if (!math::blend(pixel, alpha, s.color, s.z)) break;
        ++n_blended;
      }
      const int i = y * math::kTileSize + x;
      out.r[i] = pixel.r, out.g[i] = pixel.g, out.b[i] = pixel.b;
      out.depth[i] = pixel.depth, out.transmittance[i] = pixel.transmittance;
      out.evaluated[i] = n_evaluated, out.blended[i] = n_blended;
    }
  }
}

template <Exponent X>
void blend_with(const TileJob& job, TilePixels& out) {
  switch (job.exp) {
    case Exp::exact: return blend_tile<X, Exp::exact>(job, out);
    case Exp::paper: return blend_tile<X, Exp::paper>(job, out);
    case Exp::zero_mean: return blend_tile<X, Exp::zero_mean>(job, out);
  }
}

}  // namespace

void blend_tile_scalar(const TileJob& job, TilePixels& pixels) {
  return job.exponent == Exponent::direct ? blend_with<Exponent::direct>(job, pixels)
                                          : blend_with<Exponent::folded>(job, pixels);
}

}  // namespace rgs::detail
