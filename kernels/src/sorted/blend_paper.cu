// blend_paper.cu - the paper's blending loop: folded coefficients, two pixels a thread, exponential by a shift.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp: fold(), folded_exponent(), negative_exp2(); the paper, III-B
// In/Out  as blend.cu
// Cost    a pair of pixels and a Gaussian: 8 FMA-pipe instructions, 2 comparisons, 24 B of shared memory to each lane; if a
//         pixel of the warp counts, 22 more instructions and 16 B
// Launch  a block of 128 threads a tile
// Shared  Batch: coefficients xx, xy, yy, x and y, one; colours; 5 KiB
// Order   front to back; deterministic
//
// One word is a pixel's state: its transmittance, negated once the pixel is finished. Every later product is then
// negative, fails the test against 1e-4 and changes nothing, so finished pixels need neither a flag nor a branch.
#include <cstdint>
#include <type_traits>

#include "common/store_pixel.cuh"
#include "sorted/blend_paper.hpp"
#include "sorted/blend_pixel.cuh"

namespace rgs::cuda {
namespace {

constexpr int kThreads = kTilePixels / 2;

struct Batch {
  float4 quadratic[kThreads];  // xx, xy, yy, x
  float2 linear[kThreads];     // y, one (biased)
  float4 color[kThreads];      // r, g, b, unused
};

struct Accumulated {
  float r = 0, g = 0, b = 0;  // of negated weights
  float t = 1;                // transmittance, negated once finished
};

// Skipped pairs have alpha 0 and leave a pixel as it is. `cutoff` is the biased log2(1/255).
__device__ inline void blend_biased(Accumulated& p, float biased, float cutoff, const float4& color) {
  const float exponential = math::negative_exp2(math::min(biased, math::kBiasedAlphaMax));
  const float minus_alpha = biased >= cutoff ? exponential : 0.0F;
  const float next = fmaf(minus_alpha, p.t, p.t);
  const bool blends = next >= math::kTransmittanceMin;
  const float weight = blends ? minus_alpha * p.t : 0.0F;
  p.r = fmaf(weight, color.x, p.r);
  p.g = fmaf(weight, color.y, p.g);
  p.b = fmaf(weight, color.z, p.b);
  p.t = blends ? next : -fabsf(p.t);
}

// With PixelArrays among the arguments the compiler allocates registers differently, in the loop too, which made the
// longest tile a tenth slower where it was measured. Most frames are tight, so they have a kernel of their own.
template <math::Exp E, class Arrays>
__global__ void __launch_bounds__(kThreads) paper_kernel(BlendArgumentsFor<Arrays> a) {
  __shared__ Batch s;
  constexpr float kBias = math::exp2_bias(math::exp_sigma<E>());
  constexpr float kCutoff = math::kLog2AlphaMin + kBias;
  const auto at = TilePixel<2>::of_thread();
  const auto x = static_cast<float>(at.x), y = static_cast<float>(at.y);
  const math::PixelPoint<float> corner{static_cast<float>(blockIdx.x * math::kTileSize),
                                       static_cast<float>(blockIdx.y * math::kTileSize)};
  const TileRange range = a.ranges[blockIdx.y * gridDim.x + blockIdx.x];

  Accumulated above, below;
  if (!at.inside(0, a.width, a.height)) above.t = -1;
  if (!at.inside(1, a.width, a.height)) below.t = -1;

  for (std::uint32_t begin = range.begin; begin < range.end; begin += kThreads) {
    if (__syncthreads_and(above.t < 0 && below.t < 0)) break;  // all have read the batch before
    if (begin + threadIdx.x < range.end) {
      const ScreenSplat splat = a.splats[a.gaussians[begin + threadIdx.x]];
      const auto f = math::fold(splat.conic, {splat.mean.u - corner.u, splat.mean.v - corner.v}, splat.log2_opacity);
      s.quadratic[threadIdx.x] = {f.xx, f.xy, f.yy, f.x};
      s.linear[threadIdx.x] = {f.y, f.one + kBias};
      s.color[threadIdx.x] = {splat.color.x, splat.color.y, splat.color.z, 0};
    }
    __syncthreads();
    const int n = static_cast<int>(math::min<std::uint32_t>(kThreads, range.end - begin));
    for (int j = 0; j < n; ++j) {
      const float4 q = s.quadratic[j];
      const float2 l = s.linear[j];
      const math::Folded<float> f{q.x, q.y, q.z, q.w, l.x, l.y};
      const float first = math::folded_exponent(f, x, y);
      const float second = math::folded_exponent_below(f, first, x, y);
      if (math::max(first, second) < kCutoff) continue;
      const float4 color = s.color[j];
      blend_biased(above, first, kCutoff, color);
      blend_biased(below, second, kCutoff, color);
      if (math::max(above.t, below.t) < 0) break;
    }
  }
  const auto store = [&](int k, const Accumulated& p) {
    if (!at.inside(k, a.width, a.height)) return;
    const math::Pixel<float> pixel{-p.r, -p.g, -p.b, 0, fabsf(p.t)};
    if constexpr (std::is_same_v<Arrays, TightArrays>) {
      store_pixel<false>(a.target, a.background, TightPixel{at.index(k, a.width)}, pixel, 0, 0);
    } else {
      store_pixel<false>(a.target, a.background, PitchedPixel{at.image_x(), at.image_y(k)}, pixel, 0, 0);
    }
  };
  store(0, above);
  store(1, below);
}

template <math::Exp E, class Arrays>
void run(const BlendArgumentsFor<Arrays>& a, Stream stream) {
  const dim3 grid(static_cast<unsigned>(a.grid.columns), static_cast<unsigned>(a.grid.rows));
  paper_kernel<E, Arrays><<<grid, kThreads, 0, stream>>>(a);
}

template <class Arrays>
void run(const BlendArgumentsFor<Arrays>& a, Stream stream) {
  a.exp == math::Exp::paper ? run<math::Exp::paper>(a, stream) : run<math::Exp::zero_mean>(a, stream);
}

}  // namespace

void run_paper_blend(const BlendArguments& a, Stream stream) {
  if (!a.target.is_tight(a.width)) return run(a, stream);
  run(BlendArgumentsFor<TightArrays>{a.ranges, a.gaussians, a.splats, a.grid, a.width, a.height, a.background, a.target,
                                     a.counters, a.exponent, a.exp, a.pixels_per_thread},
      stream);
}

}  // namespace rgs::cuda
