// tile_blend_scalar.cpp - the definition of a pixel: each pixel walks its tile's list.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <vector>

#include "cpu/tile_blend.hpp"

namespace rgs::detail {
namespace {

using math::Exp;
using math::Exponent;

// Folded coefficients of a tile's list, made once per tile as in the kernels; empty for the direct exponent.
template <Exponent X>
std::vector<math::Folded<float>> fold_list(const TileJob& job) {
  std::vector<math::Folded<float>> folded;
  if constexpr (X == Exponent::folded) {
    folded.reserve(job.list.size());
    for (const std::uint32_t index : job.list) {
      const ScreenSplat& s = job.splats[index];
      const math::PixelPoint<float> local{s.mean.u - static_cast<float>(job.x), s.mean.v - static_cast<float>(job.y)};
      folded.push_back(math::fold(s.conic, local, s.log2_opacity));
    }
  }
  return folded;
}

template <Exponent X, Exp E>
std::uint64_t blend_tile(const TileJob& job, TilePixels& out) {
  const auto folded = fold_list<X>(job);
  std::uint64_t total = 0;
  for (int y = 0; y < job.height; ++y) {
    for (int x = 0; x < job.width; ++x) {
      math::Pixel<float> pixel;
      std::uint32_t n_evaluated = 0, n_blended = 0;
      for (std::size_t k = 0; k < job.list.size(); ++k) {
        const ScreenSplat& s = job.splats[job.list[k]];
        ++n_evaluated;
        float alpha;
        if constexpr (X == Exponent::direct) {
          const float dx = s.mean.u - static_cast<float>(job.x + x), dy = s.mean.v - static_cast<float>(job.y + y);
          alpha = math::alpha_direct<E>(math::power(s.conic, dx, dy), s.opacity, s.cutoff);
        } else {
          alpha = math::alpha_folded<E>(math::folded_exponent(folded[k], static_cast<float>(x), static_cast<float>(y)));
        }
        if (alpha == 0) continue;
        const float weight = alpha * pixel.transmittance;
        if (!math::blend(pixel, alpha, s.color, s.z)) break;
        ++n_blended;
        if (job.weights != nullptr) {
          job.weights[k].sum += weight;
          job.weights[k].largest = std::max(job.weights[k].largest, weight);
        }
      }
      const int i = y * math::kTileSize + x;
      out.r[i] = pixel.r, out.g[i] = pixel.g, out.b[i] = pixel.b;
      out.depth[i] = pixel.depth, out.transmittance[i] = pixel.transmittance;
      out.evaluated[i] = n_evaluated, out.blended[i] = n_blended;
      total += n_blended;
    }
  }
  return total;
}

template <Exponent X>
std::uint64_t blend_with(const TileJob& job, TilePixels& out) {
  switch (job.exp) {
    case Exp::paper: return blend_tile<X, Exp::paper>(job, out);
    case Exp::zero_mean: return blend_tile<X, Exp::zero_mean>(job, out);
    default: return blend_tile<X, Exp::exact>(job, out);
  }
}

}  // namespace

std::uint64_t blend_tile_scalar(const TileJob& job, TilePixels& pixels) {
  return job.exponent == Exponent::direct ? blend_with<Exponent::direct>(job, pixels)
                                          : blend_with<Exponent::folded>(job, pixels);
}

}  // namespace rgs::detail
