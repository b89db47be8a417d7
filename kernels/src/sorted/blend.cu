// blend.cu - blends sorted Gaussians into a tile's pixels: the original's loop and its variants; a block a tile.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp; docs/format/RENDERING.md "A pixel"; the paper, III-B1
// In/Out  ranges, sorted Gaussians, splats -> pixels
// Cost    48 B gathered a pair, mostly from L2; about 25 instructions a (pixel, Gaussian) pair evaluated
// Launch  a block a tile; 256 threads of one pixel or 128 of two, (x, y) and (x, y + 1)
// Shared  Staged [threads]: the next batch of Gaussians for all pixels; 11 or 5.5 KiB
// Order   front to back in each pixel; counters are integer sums: deterministic
#include <cstdint>

#include "common/launch.cuh"
#include "common/store_pixel.cuh"
#include "sorted/blend.hpp"
#include "sorted/blend_paper.hpp"
#include "sorted/blend_pixel.cuh"

namespace rgs::cuda {
namespace {

using math::Exp;
using math::Exponent;

// Shared memory's copy of a Gaussian, and the opacities of a thread's pixels. (x, y) is tile-local; `corner` is the
// tile's first pixel.
template <Exponent X, Exp E>
struct Staged;

template <Exp E>
struct Staged<Exponent::direct, E> {
  math::PixelPoint<float> mean;
  math::Conic<float> conic;
  float opacity, cutoff, z;
  math::Vec3<float> color;

  __device__ static Staged of(const ScreenSplat& s, const math::PixelPoint<float>& corner) {
    // Exact where it matters: for a mean within a factor of two of the corner (Sterbenz).
    return {{s.mean.u - corner.u, s.mean.v - corner.v}, s.conic, s.opacity, s.cutoff, s.z, s.color};
  }
  template <int N>
  __device__ void alphas(float x, float y, float (&alpha)[N]) const {
#pragma unroll
    for (int k = 0; k < N; ++k) {
      const float dx = mean.u - x, dy = mean.v - (y + static_cast<float>(k));
      alpha[k] = math::alpha_direct<E>(math::power(conic, dx, dy), opacity, cutoff);
    }
  }
};

template <Exp E>
struct Staged<Exponent::folded, E> {
  math::Folded<float> folded;
  float z;
  math::Vec3<float> color;

  __device__ static Staged of(const ScreenSplat& s, const math::PixelPoint<float>& corner) {
    return {math::fold(s.conic, {s.mean.u - corner.u, s.mean.v - corner.v}, s.log2_opacity), s.z, s.color};
  }
  template <int N>
  __device__ void alphas(float x, float y, float (&alpha)[N]) const {
    float exponent = math::folded_exponent(folded, x, y);
    alpha[0] = math::alpha_folded<E>(exponent);
    if constexpr (N == 2) {
      exponent = math::folded_exponent_below(folded, exponent, x, y);
      alpha[1] = math::alpha_folded<E>(exponent);
    }
  }
};

// Limits registers so that blocks of 256 threads fill a multiprocessor; the stores at the end alone would take more.
template <Exponent X, Exp E, int N, bool Details>
__global__ void __launch_bounds__(kTilePixels / N, N == 1 ? resident_blocks(8, kTilePixels) : 1)
    blend_kernel(BlendArguments a) {
  constexpr int kThreads = kTilePixels / N;
  __shared__ Staged<X, E> staged[kThreads];
  const auto at = TilePixel<N>::of_thread();
  const math::PixelPoint<float> corner{static_cast<float>(blockIdx.x * math::kTileSize),
                                       static_cast<float>(blockIdx.y * math::kTileSize)};
  const auto x = static_cast<float>(at.x), y = static_cast<float>(at.y);
  const TileRange range = a.ranges[blockIdx.y * gridDim.x + blockIdx.x];

  math::Pixel<float> pixel[N];
  bool done[N];
  std::uint32_t n_evaluated[N] = {}, n_blended[N] = {};
#pragma unroll
  for (int k = 0; k < N; ++k) done[k] = !at.inside(k, a.width, a.height);
  const auto all_done = [&] {
    bool all = true;
#pragma unroll
    for (int k = 0; k < N; ++k) all = all && done[k];
    return all;
  };

  for (std::uint32_t begin = range.begin; begin < range.end; begin += kThreads) {
    if (__syncthreads_and(all_done())) break;  // all have read the batch before
    if (begin + threadIdx.x < range.end) {
      staged[threadIdx.x] = Staged<X, E>::of(a.splats[a.gaussians[begin + threadIdx.x]], corner);
    }
    __syncthreads();
    const int n = static_cast<int>(math::min<std::uint32_t>(kThreads, range.end - begin));
    for (int j = 0; j < n && !all_done(); ++j) {
      const Staged<X, E>& s = staged[j];
      float alpha[N];
      s.alphas(x, y, alpha);
#pragma unroll
      for (int k = 0; k < N; ++k) {
        if (Details && !done[k]) ++n_evaluated[k];
        if (done[k] || alpha[k] == 0) continue;
        if (math::blend(pixel[k], alpha[k], s.color, Details ? s.z : 0.0F)) {
          if (Details) ++n_blended[k];
        } else {
          done[k] = true;
        }
      }
    }
  }
#pragma unroll
  for (int k = 0; k < N; ++k) {
    if (at.inside(k, a.width, a.height)) {
      store_pixel<Details>(a.target, a.background, PitchedPixel{at.image_x(), at.image_y(k)}, pixel[k], n_evaluated[k],
                           n_blended[k]);
    }
  }
  if constexpr (Details) {
    if (a.counters != nullptr) count_pairs<N>(*a.counters, n_evaluated, n_blended);
  }
}

template <Exponent X, Exp E, int N>
void run(const BlendArguments& a, bool details, Stream stream) {
  const dim3 grid(static_cast<unsigned>(a.grid.columns), static_cast<unsigned>(a.grid.rows));
  constexpr int kThreads = kTilePixels / N;
  details ? blend_kernel<X, E, N, true><<<grid, kThreads, 0, stream>>>(a)
          : blend_kernel<X, E, N, false><<<grid, kThreads, 0, stream>>>(a);
}

template <Exponent X, Exp E>
void run(const BlendArguments& a, bool details, Stream stream) {
  a.pixels_per_thread == 2 ? run<X, E, 2>(a, details, stream) : run<X, E, 1>(a, details, stream);
}

template <Exponent X>
void run(const BlendArguments& a, bool details, Stream stream) {
  switch (a.exp) {
    case Exp::paper: return run<X, Exp::paper>(a, details, stream);
    case Exp::zero_mean: return run<X, Exp::zero_mean>(a, details, stream);
    default: return run<X, Exp::exact>(a, details, stream);
  }
}

}  // namespace

Status launch_blend(const BlendArguments& a, Stream stream) {
  const PixelArrays& t = a.target;
  const bool details = t.depth != nullptr || t.evaluated != nullptr || t.blended != nullptr || a.counters != nullptr;
  if (a.exponent == Exponent::direct) {
    run<Exponent::direct>(a, details, stream);
  } else if (a.pixels_per_thread == 2 && a.exp != Exp::exact && !details) {
    run_paper_blend(a, stream);
  } else {
    run<Exponent::folded>(a, details, stream);
  }
  return launched("the blending kernel could not be launched");
}

}  // namespace rgs::cuda
