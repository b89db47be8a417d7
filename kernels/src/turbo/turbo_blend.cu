// turbo_blend.cu - blends the cells in FP32, with depth and counts if wanted; a warp a cell.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp: fold(), its polynomial by columns; docs/format/RENDERING.md "A pixel"
// In/Out  cells, cell_gaussians, splats -> pixels
// Cost    a Gaussian of a cell: 52 B gathered by one lane, 32 B of shared memory to each lane, and about 12
//         instructions a pixel
// Launch  256 threads a tile: eight warps, each with a cell; a thread has four pixels of one column, which share what it reads
//         of a Gaussian and its polynomial in y (numbers for cells of 16x8)
// Shared  32 Gaussians a warp: 8 KiB
// Order   that of the cells' lists: deterministic
#include <cuda_fp16.h>

#include <cstdint>
#include <limits>

#include "common/atomic_add.cuh"
#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "common/store_pixel.cuh"
#include "rgs/quantize.hpp"
#include "turbo/exp2_approximate.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kWarps = kTurboCells;
constexpr int kThreads = 32 * kWarps;
constexpr int kRows = kTurboCellWidth * kTurboCellHeight / 32;  // a thread's pixels
static_assert(32 % kTurboCellWidth == 0 && kTurboCellHeight % kRows == 0,
              "a warp has whole rows of pixels, and a thread its share of one column");

// A Gaussian for a cell's pixels; coordinates relative to the cell's first pixel.
struct Staged {
  float4 quadratic;  // xx, xy, yy, x
  float4 rest;       // y, one, colour in FP16: r g, b
};

struct Accumulated {
  float r = 0, g = 0, b = 0, depth = 0;
  float t = 1;
  std::uint32_t evaluated = 0, blended = 0;
};

// Whether an opacity may exceed kAlphaMax in the cell, including the exponent's rounding: large terms cancel in it for
// needles.
__device__ inline bool may_exceed(const ScreenSplat& splat, float corner_x, float corner_y) {
  constexpr float kLog2AlphaMax = -0.0144996F;
  constexpr float kRounding = 4 * math::kLog2E * 6e-8F;
  const float dx = fabsf(splat.mean.u - corner_x) + kTurboCellWidth,
              dy = fabsf(splat.mean.v - corner_y) + kTurboCellHeight;
  const float terms = splat.conic.a * dx * dx + splat.conic.c * dy * dy;
  return !(splat.log2_opacity + kRounding * terms < kLog2AlphaMax);
}

// Depths must stay finite, too.
constexpr float kLargest = std::numeric_limits<float>::max();

__device__ inline Staged stage(const ScreenSplat& splat, float corner_x, float corner_y) {
  const auto f = math::fold(splat.conic, {splat.mean.u - corner_x, splat.mean.v - corner_y}, splat.log2_opacity);
  // Finite even if the colour is not, so that a weight of 0 leaves a pixel as it is.
  const __half2 red_green = __floats2half2_rn(math::min(splat.color.x, kHalfMax), math::min(splat.color.y, kHalfMax));
  const __half2 blue = __floats2half2_rn(math::min(splat.color.z, kHalfMax), 0.0F);
  return {{f.xx, f.xy, f.yy, f.x},
          {f.y, f.one, __uint_as_float(*reinterpret_cast<const std::uint32_t*>(&red_green)),
           __uint_as_float(*reinterpret_cast<const std::uint32_t*>(&blue))}};
}

// A Gaussian's opacities in a thread's column of pixels, 0 for skipped pairs, and its colour.
struct Column {
  float alpha[kRows];
  float r, g, b;
};

template <bool Clamp>
__device__ inline Column column_of(const Staged& s, float x, const float (&y)[kRows]) {
  const math::Folded<float> f{s.quadratic.x, s.quadratic.y, s.quadratic.z, s.quadratic.w, s.rest.x, s.rest.y};
  const std::uint32_t red_green = __float_as_uint(s.rest.z), blue = __float_as_uint(s.rest.w);
  const float2 rg = __half22float2(*reinterpret_cast<const __half2*>(&red_green));
  Column c;
  c.r = rg.x, c.g = rg.y, c.b = __low2float(*reinterpret_cast<const __half2*>(&blue));
  const float constant = fmaf(fmaf(f.xx, x, f.x), x, f.one);
  const float linear = fmaf(f.xy, x, f.y);
#pragma unroll
  for (int k = 0; k < kRows; ++k) {
    const float exponent = fmaf(fmaf(f.yy, y[k], linear), y[k], constant);
    const float alpha = exp2_approximate(exponent);
    c.alpha[k] = exponent >= math::kLog2AlphaMin ? (Clamp ? math::min(alpha, math::kAlphaMax) : alpha) : 0.0F;
  }
  return c;
}

// Blends one Gaussian into a column of pixels. A pixel does not stop at the definition's transmittance of 1e-4 but when
// its whole cell has fallen below it: the rest adds less than 1e-4.
template <bool Details>
__device__ inline void blend_column(Accumulated (&pixel)[kRows], const Column& c, float z) {
#pragma unroll
  for (int k = 0; k < kRows; ++k) {
    Accumulated& p = pixel[k];
    if (Details && p.t >= math::kTransmittanceMin) {
      ++p.evaluated;
      if (c.alpha[k] > 0) ++p.blended;
    }
    const float weight = c.alpha[k] * p.t;
    p.t -= weight;
    p.r = fmaf(weight, c.r, p.r);
    p.g = fmaf(weight, c.g, p.g);
    p.b = fmaf(weight, c.b, p.b);
    if (Details) p.depth = fmaf(weight, z, p.depth);
  }
}

template <bool Details>
class Cell {
 public:
  using Staging = Staged[32];

  __device__ Cell(int corner_x, int corner_y, int width, int height)
      : corner_x_(static_cast<float>(corner_x)), corner_y_(static_cast<float>(corner_y)) {
    const int lane = static_cast<int>(threadIdx.x % 32);
    x_ = static_cast<float>(lane % kTurboCellWidth);
#pragma unroll
    for (int k = 0; k < kRows; ++k) {
      const int y = kRows * (lane / kTurboCellWidth) + k;
      y_[k] = static_cast<float>(y);
      // A pixel outside the image counts as finished.
      pixel_[k].t = corner_x + lane % kTurboCellWidth < width && corner_y + y < height ? 1.0F : 0.0F;
    }
  }

  // Blends gaussians[0 .. n - 1], n <= 32; true once all pixels are opaque.
  __device__ bool blend(const ScreenSplat* splats, const std::uint32_t* gaussians, int n, Staging& staged) {
    const int lane = static_cast<int>(threadIdx.x % 32);
    float z = 0;
    bool clamp = false;
    if (lane < n) {
      const ScreenSplat splat = splats[gaussians[lane]];
      staged[lane] = stage(splat, corner_x_, corner_y_);
      z = math::min(splat.z, kLargest);
      clamp = may_exceed(splat, corner_x_, corner_y_);
    }
    __syncwarp();
    // If one opacity exceeds kAlphaMax all 32 are clamped; mostly none does.
    __any_sync(kFullWarp, clamp) ? blend_staged<true>(staged, n, z) : blend_staged<false>(staged, n, z);
    bool opaque = true;
#pragma unroll
    for (const Accumulated& p : pixel_) opaque = opaque && p.t < math::kTransmittanceMin;
    return __all_sync(kFullWarp, opaque);
  }

  __device__ void store(const TurboBlendArguments& a) const {
    const int x = static_cast<int>(corner_x_ + x_), y = static_cast<int>(corner_y_ + y_[0]);
    if (x >= a.width) return;
#pragma unroll
    for (int k = 0; k < kRows; ++k) {
      if (y + k >= a.height) return;
      const Accumulated& p = pixel_[k];
      const math::Pixel<float> pixel{p.r, p.g, p.b, p.depth, p.t};
      store_pixel<Details>(a.target, a.background, PitchedPixel{x, y + k}, pixel, p.evaluated, p.blended);
      if constexpr (Details) {
        if (a.count_pairs) {
          atomic_add(a.arrays.state->counters.evaluated, p.evaluated);
          atomic_add(a.arrays.state->counters.blended, p.blended);
        }
      }
    }
  }

 private:
  template <bool Clamp>
  __device__ void blend_staged(const Staged* staged, int n, float z) {
#pragma unroll(Details ? 1 : 2)  // two at a time with depth and counts would take more than 64 registers
    for (int j = 0; j < n; ++j) {
      blend_column<Details>(pixel_, column_of<Clamp>(staged[j], x_, y_), Details ? __shfl_sync(kFullWarp, z, j) : 0.0F);
    }
  }

  Accumulated pixel_[kRows];
  float corner_x_, corner_y_;  // first pixel of the cell, px
  float x_, y_[kRows];         // the thread's pixels, relative to it
};

template <bool Details>
__global__ void __launch_bounds__(kThreads, 4) turbo_blend_kernel(TurboBlendArguments a) {
  __shared__ typename Cell<Details>::Staging staging[kWarps];
  const std::uint32_t warp = threadIdx.x / 32;
  const TurboCell own = a.arrays.cells[kTurboCells * blockIdx.x + warp];
  const int corner_x = static_cast<int>(own.x), corner_y = static_cast<int>(own.y);
  if (corner_x >= a.width || corner_y >= a.height) return;
  Cell<Details> cell(corner_x, corner_y, a.width, a.height);
  const std::uint32_t* const gaussians = a.arrays.cell_gaussians + own.begin;
  bool opaque = false;
  for (std::uint32_t k = 0; k < own.n && !opaque; k += 32) {
    opaque = cell.blend(a.splats, gaussians + k, static_cast<int>(math::min(own.n - k, 32u)), staging[warp]);
    __syncwarp();
  }
  cell.store(a);
}

}  // namespace

Status launch_turbo_blend(const TurboBlendArguments& a, Stream stream) {
  const auto kernel = a.has_details() ? turbo_blend_kernel<true> : turbo_blend_kernel<false>;
  kernel<<<a.arrays.n_tiles, kThreads, 0, stream>>>(a);
  return launched("the turbo blending kernel could not be launched");
}

}  // namespace rgs::cuda
