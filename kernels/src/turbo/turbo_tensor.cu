// turbo_tensor.cu - blends the cells by matrix products in FP16: a block a cell.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp: fold(); docs/RENDERING.md "A pixel"
// In/Out  cells, cell_gaussians, splats -> pixels
// Cost    a Gaussian of a cell: 52 B gathered by one lane; a (pixel, Gaussian) pair: 24 multiply-adds of matrix
//         products, padding included, and one exponential; two pairs: about six instructions on two FP16 numbers each
// Launch  128 threads, a block a cell, tiles with the longest lists first; a warp has two rows of the cell
// Shared  Staging: 128 Gaussians; 5 KiB (numbers for cells 8 high)
// Order   that of the cells' lists: deterministic
//
// Blending 32 Gaussians into 16 pixels is two matrix products with something in between, as attention is (the register
// reuse is that of Dao et al. 2022):
//
//   exponents [16 px, 32]  =  (1, X, Y, X^2, XY, Y^2) [16 px, 6]  x  folded coefficients [6, 32]
//   weights   [16 px, 32]  =  alpha T, T the product of 1 - alpha over the Gaussians before
//   colours   [16 px, 3]  +=  weights  x  colours [32, 3]
//
// The basis about the cell's centre is exact in FP16; each coefficient is the sum of two FP16 numbers, which take the 16
// columns of a product together: 22 bits. Exponents, opacities and weights are FP16, colours gather in FP32.
//
// mma leaves two columns of 8 and two rows to a lane: pixels g and g + 8, g = lane / 4, Gaussians in the columns 2q and
// 2q + 1, q = lane % 4, of four products. Column c of product j is Gaussian 4 c + j: so each half of a lane's registers
// holds four Gaussians in a row, a chain, and a pixel's 32 Gaussians are eight chains. Transmittance goes down each
// chain on its own and then over the chains (it is associative). What the lanes hold is the left operand of the product
// with colours as it is.
#include <cuda_fp16.h>

#include <cstdint>

#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "common/store_pixel.cuh"
#include "rgs/quantize.hpp"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kRows = 2;  // of a warp
constexpr int kWarps = kTurboCellHeight / kRows;
constexpr int kThreads = 32 * kWarps;
static_assert(kTurboCellWidth == 16, "a row of a cell's pixels is the 16 rows of a product's left operand");
static_assert(kTurboCellHeight % kRows == 0, "a warp has whole rows");
// Transmittance below which a warp's pixels are finished: what comes after adds less to one than half of what FP16 tells
// apart at 1, an eighth of a step of 8 bits.
constexpr float kOpaque = 1.0F / 2048;
constexpr float kCenterX = 0.5F * (kTurboCellWidth - 1), kCenterY = 0.5F * (kTurboCellHeight - 1);
// Squares and products are odd numbers over 4.
static_assert((kTurboCellHeight - 1) * (kTurboCellHeight - 1) < 1 << 11, "the basis is exact in FP16's 11 bits");

// D = A B, FP16, [16, 16] x [16, 8]; the rows of A repeat in k: columns 8 .. 15 are columns 0 .. 7.
__device__ inline void multiply_repeated(__half2 (&d)[2], const uint4& a, uint2 b) {
  std::uint32_t low, high;
#if __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k16.row.col.f16.f16.f16.f16 {%0, %1}, {%2, %3, %4, %5}, {%6, %7}, {%8, %8};"
      : "=r"(low), "=r"(high)
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b.x), "r"(b.y), "r"(0u));
#else  // sm_75 has products of half that depth
  asm("mma.sync.aligned.m16n8k8.row.col.f16.f16.f16.f16 {%0, %1}, {%2, %3}, {%4}, {%5, %5};"
      : "=r"(low), "=r"(high)
      : "r"(a.x), "r"(a.y), "r"(b.x), "r"(0u));
  asm("mma.sync.aligned.m16n8k8.row.col.f16.f16.f16.f16 {%0, %1}, {%2, %3}, {%4}, {%0, %1};"
      : "+r"(low), "+r"(high)
      : "r"(a.z), "r"(a.w), "r"(b.y));
#endif
  d[0] = reinterpret_cast<const __half2&>(low), d[1] = reinterpret_cast<const __half2&>(high);
}

// D += A B, FP16 to FP32, [16, 16] x [16, 8].
__device__ inline void multiply_add(float (&d)[4], const __half2 (&a)[4], std::uint32_t b0, std::uint32_t b1) {
  const auto bits = [](const __half2& h) { return reinterpret_cast<const std::uint32_t&>(h); };
#if __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(bits(a[0])), "r"(bits(a[1])), "r"(bits(a[2])), "r"(bits(a[3])), "r"(b0), "r"(b1));
#else
  asm("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(bits(a[0])), "r"(bits(a[1])), "r"(b0));
  asm("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(bits(a[2])), "r"(bits(a[3])), "r"(b1));
#endif
}

__device__ inline __half2 exp2_approximate(__half2 x) {
  __half2 y;
  asm("ex2.approx.f16x2 %0, %1;"
      : "=r"(reinterpret_cast<std::uint32_t&>(y))
      : "r"(reinterpret_cast<const std::uint32_t&>(x)));
  return y;
}
// Opacities are kept over kAlphaMax, as it is in FP16: saturation at 1 then clamps them.
inline constexpr float kAlphaScale = 0.990234375F;
// The exponential's mean relative error over [-8, 0] is -2.9e-4 (measured on sm_90): 4.2e-4 of the exponent. The rest is
// -log2(kAlphaScale).
inline constexpr float kExponentBias = 4.2e-4F + 0.01415806F;

// 1 where the exponent is at least kLog2AlphaMin + kExponentBias = -7.9798, 0 elsewhere: FP16 has -7.9766 and -7.9805
// there.
__device__ inline __half2 counts(__half2 exponent) {
  return __hfma2_sat(exponent, __float2half2_rn(256.0F), __float2half2_rn(2043.0F));
}

// 32 Gaussians as right operands.
struct alignas(16) Staging {
  // Of the first product, Gaussian 4 c + j at 8 j + c: high and low halves of two coefficients for each q; those of q = 3
  // meet zeros.
  uint2 coefficients[32][4];
  // Of the second, times kAlphaMax. Of a channel, lane q's four registers lie together.
  __half color[3][32];
};

// Two coefficients as sums of two FP16 numbers each.
__device__ inline uint2 split(float a, float b) {
  const __half2 high = __floats2half2_rn(a, b);
  const float2 back = __half22float2(high);
  const __half2 low = __floats2half2_rn(a - back.x, b - back.y);
  return {reinterpret_cast<const std::uint32_t&>(high), reinterpret_cast<const std::uint32_t&>(low)};
}

// A warp stages gaussians[0 .. n - 1], n <= 32, a lane each. Up to 16 take the first two products: Gaussian 2 c + j.
__device__ inline void stage(const ScreenSplat* splats, const std::uint32_t* gaussians, std::uint32_t n, float corner_x,
                             float corner_y, Staging& staging) {
  const std::uint32_t slot = threadIdx.x % 32;
  const std::uint32_t column = slot % 8, product = slot / 8;
  const std::uint32_t place = 8 * (column / 2) + 2 * product + column % 2;
  math::Folded<float> f{0, 0, 0, 0, 0, -1000.0F};  // nothing
  math::Vec3<float> color{0, 0, 0};
  const std::uint32_t own = n > 16 ? 4 * column + product : product < 2 ? 2 * column + product : 32;
  if (own < n) {
    const ScreenSplat splat = splats[gaussians[own]];
    f = math::fold(splat.conic, {splat.mean.u - corner_x - kCenterX, splat.mean.v - corner_y - kCenterY},
                   splat.log2_opacity + kExponentBias);
    // Finite also where the colour is not: a weight of 0 then leaves a pixel as it is.
    const auto scaled = [](float c) { return kAlphaScale * math::min(c, kHalfMax); };
    color = {scaled(splat.color.x), scaled(splat.color.y), scaled(splat.color.z)};
  }
  const uint2 pairs[3] = {split(f.one, f.x), split(f.y, f.xx), split(f.xy, f.yy)};
  auto* const to = reinterpret_cast<uint4*>(staging.coefficients[slot]);
  to[0] = {pairs[0].x, pairs[0].y, pairs[1].x, pairs[1].y};
  to[1] = {pairs[2].x, pairs[2].y, 0, 0};
  staging.color[0][place] = __float2half_rn(color.x);
  staging.color[1][place] = __float2half_rn(color.y);
  staging.color[2][place] = __float2half_rn(color.z);
}

// 16 pixels of a row, as lane (g, q) has them.
struct Row {
  uint4 basis;     // left operand of the first product: two registers, repeated
  __half2 t;       // transmittance of the pixels g and g + 8
  float color[4];  // channels 2q and 2q + 1 of the pixels g and g + 8

  __device__ Row(int x, int y, int row, int width, int height) {
    const int g = static_cast<int>(threadIdx.x % 32 / 4), q = static_cast<int>(threadIdx.x % 4);
    // (1, X), (Y, X^2) or (XY, Y^2), each its own lanes', without a branch.
    const float center_y = static_cast<float>(row) - kCenterY;
    const float first = q == 0 ? 1 : 0, second = q == 1 ? 1 : 0, third = q == 2 ? 1 : 0;
    const auto values = [&](float center_x) {
      const __half2 pair =
          __floats2half2_rn(fmaf(center_y, fmaf(third, center_x, second), first),
                            fmaf(center_x, fmaf(second, center_x, first), third * center_y * center_y));
      return reinterpret_cast<const std::uint32_t&>(pair);
    };
    basis.x = basis.z = values(static_cast<float>(g) - kCenterX);
    basis.y = basis.w = values(static_cast<float>(g + 8) - kCenterX);
    // A pixel outside the image keeps nobody waiting.
    t = __floats2half2_rn(y < height && x + g < width ? 1.0F : 0.0F, y < height && x + g + 8 < width ? 1.0F : 0.0F);
    for (float& sum : color) sum = 0;
  }
  template <int Products>
  __device__ void blend(const uint2 (&coefficients)[4], const uint4& colors);
  // The pixel that the lane stores: lanes q = 0 hold red and green, lanes q = 1 blue; the former get the pixels g, the
  // latter the pixels g + 8.
  __device__ math::Pixel<float> pixel(bool is_odd) const {
    const float other = __shfl_xor_sync(kFullWarp, is_odd ? color[0] : color[2], 1);
    const float green = __shfl_xor_sync(kFullWarp, color[3], 1);
    return {is_odd ? other : color[0], is_odd ? green : color[1], is_odd ? color[2] : other, 0,
            is_odd ? __high2float(t) : __low2float(t)};
  }
};

// Blends the Gaussians of the first Products products, 2 or 4.
template <int Products>
__device__ inline void Row::blend(const uint2 (&coefficients)[4], const uint4& colors) {
  const __half2 one = __float2half2_rn(1.0F), scale = __float2half2_rn(-kAlphaScale);
  __half2 weight[Products][2];    // [place in the chain][pixel], two chains each; opacities at first
  __half2 chain[2] = {one, one};  // what each chain lets through
#pragma unroll
  for (int j = 0; j < Products; ++j) {
    multiply_repeated(weight[j], basis, coefficients[j]);
#pragma unroll
    for (int p = 0; p < 2; ++p) {
      const __half2 opacity = __hmul2_sat(exp2_approximate(weight[j][p]), counts(weight[j][p]));
      weight[j][p] = j == 0 ? opacity : __hmul2(opacity, chain[p]);
      chain[p] = __hfma2(scale, weight[j][p], chain[p]);
    }
  }
  // Over the chains, both pixels at a time: what the lanes before let through, and all of them.
  const __half2 first = __lows2half2(chain[0], chain[1]);
  const __half2 both = __hmul2(first, __highs2half2(chain[0], chain[1]));
  const __half2 neighbour = __shfl_xor_sync(kFullWarp, both, 1);
  const __half2 pair = __hmul2(both, neighbour);
  const __half2 others = __shfl_xor_sync(kFullWarp, pair, 2);
  const __half2 before = __hmul2((threadIdx.x & 1) != 0 ? neighbour : one, (threadIdx.x & 2) != 0 ? others : one);
  const __half2 low = __hmul2(t, before);    // at the lane's first chain
  const __half2 high = __hmul2(low, first);  // at its second
  t = __hmul2(t, __hmul2(pair, others));
  const __half2 begin[2] = {__lows2half2(low, high), __highs2half2(low, high)};
#pragma unroll
  for (auto& values : weight) {
    for (int p = 0; p < 2; ++p) values[p] = __hmul2(values[p], begin[p]);
  }
  multiply_add(color, {weight[0][0], weight[0][1], weight[1][0], weight[1][1]}, colors.x, colors.y);
  if constexpr (Products == 4) {
    multiply_add(color, {weight[2][0], weight[2][1], weight[3][0], weight[3][1]}, colors.z, colors.w);
  }
}

__global__ void __launch_bounds__(kThreads, resident_blocks(1280 / kThreads, kThreads))
    turbo_tensor_kernel(TurboBlendArguments a) {
  __shared__ Staging staged[kWarps];
  const int warp = static_cast<int>(threadIdx.x / 32), lane = static_cast<int>(threadIdx.x % 32);
  const TurboCell cell = a.arrays.cells[blockIdx.x];
  const int x = static_cast<int>(cell.x), y = static_cast<int>(cell.y);
  if (x >= a.width || y >= a.height) return;
  Row rows[kRows] = {Row(x, y + kRows * warp, kRows * warp, a.width, a.height),
                     Row(x, y + kRows * warp + 1, kRows * warp + 1, a.width, a.height)};
  const std::uint32_t* const gaussians = a.arrays.cell_gaussians + cell.begin;
  bool opaque = false;
  for (std::uint32_t begin = 0; begin < cell.n; begin += kThreads) {
    const std::uint32_t own = begin + 32 * static_cast<std::uint32_t>(warp);
    if (own < cell.n) {
      stage(a.splats, gaussians + own, math::min(cell.n - own, 32u), static_cast<float>(x), static_cast<float>(y),
            staged[warp]);
    }
    __syncthreads();
    for (int k = 0; k < kWarps && begin + 32 * static_cast<std::uint32_t>(k) < cell.n && !opaque; ++k) {
      const Staging& from = staged[k];
      uint2 coefficients[4];
#pragma unroll
      for (int j = 0; j < 4; ++j) coefficients[j] = from.coefficients[8 * j + lane / 4][lane % 4];
      uint4 colors{0, 0, 0, 0};
      if (lane / 4 < 3) colors = *reinterpret_cast<const uint4*>(from.color[lane / 4] + 8 * (lane % 4));
      if (cell.n - begin - 32 * static_cast<std::uint32_t>(k) > 16) {
#pragma unroll
        for (Row& row : rows) row.blend<4>(coefficients, colors);
      } else {
#pragma unroll
        for (Row& row : rows) row.blend<2>(coefficients, colors);
      }
      __half2 largest = rows[0].t;
#pragma unroll
      for (const Row& row : rows) largest = __hmax2(largest, row.t);
      opaque = __all_sync(kFullWarp, __hblt2(largest, __float2half2_rn(kOpaque))) != 0;
    }
    if (__syncthreads_and(opaque)) break;
  }
  const int q = lane % 4;
  math::Pixel<float> pixels[kRows];
#pragma unroll
  for (int k = 0; k < kRows; ++k) pixels[k] = rows[k].pixel(q % 2 != 0);
  const int own_x = x + lane / 4 + 8 * q, own_y = y + kRows * warp;
  if (q > 1 || own_x >= a.width) return;
#pragma unroll 1  // the code of two stores at once would take more registers than the loops above have
  for (int k = 0; k < kRows && own_y + k < a.height; ++k) {
    store_pixel<false>(a.target, a.background, PitchedPixel{own_x, own_y + k}, k == 0 ? pixels[0] : pixels[1], 0, 0);
  }
}

}  // namespace

Status launch_turbo_tensor(const TurboBlendArguments& a, Stream stream) {
  turbo_tensor_kernel<<<a.arrays.n_tiles * kTurboCells, kThreads, 0, stream>>>(a);
  return launched("the kernel of matrix products could not be launched");
}

}  // namespace rgs::cuda
