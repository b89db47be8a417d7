// turbo_tensor.cu - blends the cells by matrix products in FP16; a block a cell, or several.
// SPDX-License-Identifier: Apache-2.0
//
// Math    rgs/math/blend.hpp: fold(); docs/format/RENDERING.md "A pixel"
// In/Out  cells, cell_gaussians, splats -> pixels
// Cost    a Gaussian of a cell: 40 B gathered by one lane, 44 where it culls; a (pixel, Gaussian) pair: 24
//         multiply-adds of matrix products, padding included, and one exponential; two pairs: about five instructions
//         on two FP16 numbers each. Of long lists and segments only where the Gaussian's box meets the warp's pixels
// Launch  128 threads, a block a cell, tiles with the longest lists first; a warp has 8x4 pixels. For cells of long
//         lists, then for the rest of long cells, as many blocks as the device holds at a time, which take them in turn
// Shared  Staging: 128 Gaussians and a pixel a thread; 8 KiB, 9.3 where it culls (numbers for cells of 16x8)
// Order   that of the cells' lists: deterministic
//
// Blending 32 Gaussians into 16 pixels is two matrix products with a step in between, like attention (register reuse as
// in Dao et al. 2022):
//
//   exponents [16 px, 32]  =  (1, X, Y, X^2, XY, Y^2) [16 px, 6]  x  folded coefficients [6, 32]
//   weights   [16 px, 32]  =  alpha T, T the product of 1 - alpha over the Gaussians before
//   colours   [16 px, 3]  +=  weights  x  colours [32, 3]
//
// The basis about the cell's centre is exact in FP16; each coefficient is the sum of two FP16 numbers, 22 bits, in one
// product of depth 16. Exponents and colours accumulate in FP32; opacities and weights are FP16.
//
// The 16 pixels are two rows of 8. mma gives a lane pixel g of both, g = lane / 4, and Gaussians in columns 2q and 2q +
// 1, q = lane % 4, of four products. Column c of product j is Gaussian 4 c + j, so each half of a lane's registers has
// four consecutive Gaussians, a chain, and a pixel's 32 Gaussians are eight chains. Transmittance is multiplied down
// each chain and then over the chains (it is associative). The lanes' values are then the left operand of the product
// with colours. The last Gaussians of a batch, or of what a warp lists of it, take as few products n as hold them:
// column c of product j is Gaussian n c + j.
//
// Gaussians of long lists are small, and most touch the pixels of one or two warps: of what the block stages, a warp
// lists what touches its own, and ldmatrix gathers it. The same for segments. Elsewhere it costs more than it saves.
#include <cuda_fp16.h>

#include <bit>
#include <cstdint>

#include "common/block_scan.cuh"
#include "common/launch.cuh"
#include "common/store_pixel.cuh"
#include "rgs/quantize.hpp"
#include "turbo/exp2_approximate.cuh"
#include "turbo/place_cells.cuh"
#include "turbo/turbo.hpp"

namespace rgs::cuda {
namespace {

constexpr int kWarpWidth = 8, kWarpHeight = 4;  // px of a warp
constexpr int kWarpColumns = kTurboCellWidth / kWarpWidth;
constexpr int kWarps = kWarpColumns * kTurboCellHeight / kWarpHeight;
constexpr int kRows = kWarpHeight / 2;  // of products: two rows of pixels each
constexpr int kThreads = 32 * kWarps;
// 36 warps, for cells of 16x8: with 56 registers the work of a warp's rows overlaps.
constexpr int kResident = resident_blocks(1152 / kThreads, kThreads);
static_assert(kWarpWidth == 8, "two rows of a warp's pixels are the 16 rows of a product's left operand");
static_assert(kWarpWidth * kWarpHeight == 32, "a lane a pixel");
static_assert(kTurboCellWidth % kWarpWidth == 0 && kTurboCellHeight % kWarpHeight == 0, "a cell has whole warps");
static_assert(kWarps <= 16, "a bit for each warp");
// Transmittance below which a warp's pixels are finished: the rest adds less to 1 than half of FP16's step there, an
// eighth of an 8-bit step. FP16 below it has no bit of kNotOpaque.
constexpr float kOpaque = 1.0F / 2048;
constexpr std::uint32_t kNotOpaque = 0xF000F000;  // of two
constexpr float kCenterX = 0.5F * (kTurboCellWidth - 1), kCenterY = 0.5F * (kTurboCellHeight - 1);
// Squares and products are odd numbers over 4.
constexpr int kTurboCellSide = math::max(kTurboCellWidth, kTurboCellHeight);
static_assert((kTurboCellSide - 1) * (kTurboCellSide - 1) < 1 << 11, "the basis is exact in FP16's 11 bits");

__device__ inline std::uint32_t bits_of(const __half2& h) {
  return reinterpret_cast<const std::uint32_t&>(h);
}
// D += A B, FP16 to FP32, [16, 8] x [8, 8].
__device__ inline void multiply_add(float (&d)[4], const __half2 (&a)[2], std::uint32_t b) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(bits_of(a[0])), "r"(bits_of(a[1])), "r"(b));
}
// Twice as deep.
__device__ inline void multiply_add(float (&d)[4], const __half2 (&a0)[2], const __half2 (&a1)[2], std::uint32_t b0,
                                    std::uint32_t b1) {
#if __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(bits_of(a0[0])), "r"(bits_of(a0[1])), "r"(bits_of(a1[0])), "r"(bits_of(a1[1])), "r"(b0), "r"(b1));
#else
  multiply_add(d, a0, b0);
  multiply_add(d, a1, b1);
#endif
}

// D = A B, FP16 to FP32, [16, 8] x [8, 8], where B is b.x + b.y: one product of depth 16, whose left operand `a` is A
// twice.
__device__ inline void multiply(float (&d)[4], const uint4& a, uint2 b) {
  for (float& x : d) x = 0;
  const auto half2 = [](const std::uint32_t& bits) { return reinterpret_cast<const __half2&>(bits); };
  multiply_add(d, {half2(a.x), half2(a.y)}, {half2(a.z), half2(a.w)}, b.x, b.y);
}

// Exponents are lowered so that an opacity of 1/255, the least that counts, is 2^-14 (within 2e-4), FP16's smallest
// normal number. The product that raises opacities again flushes what is below to zero and saturates at 1: they are
// kept divided by kAlphaMax as FP16 rounds it.
inline constexpr float kAlphaScale = 0.990234375F;
inline constexpr float kUnbiased = 64.875F;
inline constexpr float kExponentBias = -6.0054331F;  // -log2(kAlphaScale kUnbiased)

// Opacities over kAlphaScale.
__device__ inline __half2 opacities(float a, float b) {
  const __half2 biased = __floats2half2_rn(exp2_approximate(a), exp2_approximate(b));
  __half2 y;
  asm("mul.ftz.sat.f16x2 %0, %1, %2;"
      : "=r"(reinterpret_cast<std::uint32_t&>(y))
      : "r"(bits_of(biased)), "r"(bits_of(__float2half2_rn(kUnbiased))));
  return y;
}

// Gaussians that a block blends at a time, as right operands, eight numbers in a row, as ldmatrix gathers them. For the
// first product a Gaussian has two rows, the high and the low halves of its coefficients, whose last two numbers are
// multiplied by zeros; for the second one row, its colour times kAlphaMax, whose columns without a channel are not
// used.
template <bool Culls>
struct Staging {
  // Every 32 slots take 96 rows: for each of four products eight rows of high halves and eight of low ones, so that
  // ldmatrix puts both halves of a Gaussian in neighbouring registers; then 32 rows of colours.
  static constexpr std::uint32_t kRowsOf32 = 96;
  __device__ uint4& high(std::uint32_t slot) { return rows[slot / 32 * kRowsOf32 + slot % 32 / 8 * 16 + slot % 8]; }
  __device__ uint4& low(std::uint32_t slot) { return (&high(slot))[8]; }
  __device__ uint4& color(std::uint32_t slot) { return rows[slot / 32 * kRowsOf32 + 64 + slot % 32]; }

  uint4 rows[3 * kThreads];
  TurboPixel pixels[kThreads];
};
template <>
struct Staging<true> {
  static constexpr std::uint32_t kNone = kThreads;  // the slot of no Gaussian
  __device__ uint4& high(std::uint32_t slot) { return rows[0][slot]; }
  __device__ uint4& low(std::uint32_t slot) { return rows[1][slot]; }
  __device__ uint4& color(std::uint32_t slot) { return rows[2][slot]; }

  uint4 rows[3][kThreads + 1];
  TurboPixel pixels[kThreads];
  std::uint16_t warps[kThreads];             // whose pixels the Gaussian may touch, a bit each
  std::uint16_t touching[kWarps][kThreads];  // slots of what touches a warp's pixels, in order
};

// Two numbers as sums of two FP16 numbers each.
__device__ inline uint2 split(float a, float b) {
  const __half2 high = __floats2half2_rn(a, b);
  const float2 back = __half22float2(high);
  const __half2 low = __floats2half2_rn(a - back.x, b - back.y);
  return {bits_of(high), bits_of(low)};
}

// Of the warps' pixels, those that the bounding box of the Gaussian's ellipse meets; (u, v) is its mean from the cell's
// first pixel. All, if rounding leaves nothing of the determinant.
__device__ inline std::uint32_t touched_warps(const ScreenSplat& splat, float u, float v) {
  const math::Conic<float>& q = splat.conic;
  const float product = q.a * q.c, determinant = fmaf(-q.b, q.b, product) - 4e-7F * product;
  // math::Ellipse::level, enlarged by more than rounding can add to an exponent, over the determinant.
  const float scale = __fdividef(-2.04F * splat.cutoff + 0.02F, determinant);
  // NaN if the determinant is not positive; then no comparison is true.
  const auto root = [](float x) { return x * rsqrtf(x); };
  const float half_width = root(scale * q.c), half_height = root(scale * q.a);
  const auto beyond = [](float at, float reach, int first, int n) {
    return at - reach > static_cast<float>(first + n - 1) || at + reach < static_cast<float>(first);
  };
  std::uint32_t columns = 0, warps = 0;
#pragma unroll
  for (int c = 0; c < kWarpColumns; ++c) {
    if (!beyond(u, half_width, kWarpWidth * c, kWarpWidth)) columns |= 1u << c;
  }
#pragma unroll
  for (int r = 0; r < kWarps / kWarpColumns; ++r) {
    if (!beyond(v, half_height, kWarpHeight * r, kWarpHeight)) warps |= columns << (kWarpColumns * r);
  }
  return warps;
}

// Where Gaussians are culled, slot of a batch's Gaussian k, such that those of 4 c + j for the eight c of a product lie
// in different banks.
__device__ inline std::uint32_t slot_of(std::uint32_t k) {
  return k / 32 * 32 + k % 4 * 8 + k % 32 / 4;
}
// There, the Gaussian in the thread's slot.
__device__ inline std::uint32_t own_gaussian() {
  return threadIdx.x / 32 * 32 + threadIdx.x % 8 * 4 + threadIdx.x % 32 / 8;
}
// Products, of eight Gaussians each, that the first 32 of n need.
__device__ inline std::uint32_t products_of(std::uint32_t n) {
  return math::min((n + 7) / 8, 4u);
}

// Stages a Gaussian in the thread's slot, without opacity unless `is_any`.
template <bool Culls>
__device__ inline void stage(const ScreenSplat splat, bool is_any, float corner_x, float corner_y,
                             Staging<Culls>& staging) {
  const float u = splat.mean.u - corner_x, v = splat.mean.v - corner_y;
  if constexpr (Culls) staging.warps[own_gaussian()] = static_cast<std::uint16_t>(touched_warps(splat, u, v));
  const auto f =
      math::fold(splat.conic, {u - kCenterX, v - kCenterY}, is_any ? splat.log2_opacity + kExponentBias : -1000.0F);
  const uint2 pairs[3] = {split(f.one, f.x), split(f.y, f.xx), split(f.xy, f.yy)};
  staging.high(threadIdx.x) = {pairs[0].x, pairs[1].x, pairs[2].x, 0};
  staging.low(threadIdx.x) = {pairs[0].y, pairs[1].y, pairs[2].y, 0};
  // Finite even if the colour is not, so that a weight of 0 leaves a pixel as it is.
  const auto scaled = [](float c) { return kAlphaScale * math::min(c, kHalfMax); };
  const __half2 red_green = __floats2half2_rn(scaled(splat.color.x), scaled(splat.color.y));
  const __half2 blue = __floats2half2_rn(scaled(splat.color.z), 0);
  staging.color(threadIdx.x) = {bits_of(red_green), bits_of(blue), 0, 0};
}

// Lists those of the n staged Gaussians that touch the warp's pixels, and returns their number.
__device__ inline std::uint32_t list_touching(Staging<true>& staging, std::uint32_t n) {
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32, below = (1u << lane) - 1;
  std::uint32_t n_touching = 0;
  for (std::uint32_t first = 0; first < n; first += 32) {
    const std::uint32_t k = first + lane;
    const bool is_touching = k < n && (staging.warps[k] >> warp & 1) != 0;
    const std::uint32_t lanes = __ballot_sync(kFullWarp, is_touching);
    if (is_touching) {
      const std::uint32_t at = n_touching + static_cast<std::uint32_t>(__popc(static_cast<int>(lanes & below)));
      staging.touching[warp][at] = static_cast<std::uint16_t>(slot_of(k));
    }
    n_touching += static_cast<std::uint32_t>(__popc(static_cast<int>(lanes)));
  }
  __syncwarp();
  return n_touching;
}

// Four 8x8 matrices of FP16 whose rows the lanes name, eight a matrix. A lane gets two neighbours of row lane / 4 of
// each; transposed, of column lane / 4.
__device__ inline uint4 load_matrices(const uint4* row) {
  uint4 m;
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(m.x), "=r"(m.y), "=r"(m.z), "=r"(m.w)
               : "r"(static_cast<std::uint32_t>(__cvta_generic_to_shared(row)))
               : "memory");
  return m;
}
__device__ inline uint4 load_transposed(const uint4* row) {
  uint4 m;
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(m.x), "=r"(m.y), "=r"(m.z), "=r"(m.w)
               : "r"(static_cast<std::uint32_t>(__cvta_generic_to_shared(row)))
               : "memory");
  return m;
}

// A warp's first pixel within the cell.
RGS_HD constexpr TurboCorner first_pixel(std::uint32_t warp) {
  return {kWarpWidth * (warp % kWarpColumns), kWarpHeight * (warp / kWarpColumns)};
}
// The thread's own pixel within the cell.
__device__ inline TurboCorner own_corner() {
  const TurboCorner first = first_pixel(threadIdx.x / 32);
  return {first.x + threadIdx.x % kWarpWidth, first.y + threadIdx.x % 32 / kWarpWidth};
}

// A lane's part of the left operands of its warp's rows, in FP16, twice: pixel g of two rows of pixels, and by q (1,
// X), (Y, X^2), (XY, Y^2) or zeros. A table, since it depends on the thread alone.
struct alignas(16) Bases {
  std::uint32_t pixel[kThreads][kRows][4];
};
// n / 4 as bits of FP16, |n| < 2^11.
constexpr std::uint32_t half_of_quarters(int n) {
  if (n == 0) return 0;
  const unsigned magnitude = static_cast<unsigned>(n < 0 ? -n : n);
  const int log2 = std::bit_width(magnitude) - 1;
  return (n < 0 ? 0x8000u : 0u) | static_cast<unsigned>(log2 - 2 + 15) << 10 | (magnitude << (10 - log2) & 0x3FFu);
}
constexpr Bases bases() {
  Bases all{};
  for (int thread = 0; thread < kThreads; ++thread) {
    const int g = thread % 32 / 4, q = thread % 4;
    for (int k = 0; k < 2 * kRows; ++k) {
      const TurboCorner first = first_pixel(static_cast<std::uint32_t>(thread / 32));
      const int x = 2 * (static_cast<int>(first.x) + g) - (kTurboCellWidth - 1);  // twice the distance from the centre
      const int y = 2 * (static_cast<int>(first.y) + k) - (kTurboCellHeight - 1);
      const int low = q == 0 ? 4 : q == 1 ? 2 * y : q == 2 ? x * y : 0;
      const int high = q == 0 ? 2 * x : q == 1 ? x * x : q == 2 ? y * y : 0;
      all.pixel[thread][k / 2][k % 2] = all.pixel[thread][k / 2][k % 2 + 2] =
          half_of_quarters(low) | half_of_quarters(high) << 16;
    }
  }
  return all;
}
__device__ constexpr Bases kBases = bases();

// Two rows of 8 pixels, as lane (g, q) holds them.
struct Row {
  uint4 basis;     // left operand of the first product, twice
  __half2 t;       // transmittance of pixel g of both
  float color[4];  // channels 2q and 2q + 1 of pixel g of the first row, then of the second; the fourth is unused

  __device__ explicit Row(int row) : t{__float2half2_rn(1.0F)}, color{} {
    basis = reinterpret_cast<const uint4&>(kBases.pixel[threadIdx.x][row]);
  }
  template <int Products>
  __device__ void blend(const uint2 (&coefficients)[4], const uint4& colors);
};

// Blends the Gaussians of the first Products products, 1 to 4.
template <int Products>
__device__ inline void Row::blend(const uint2 (&coefficients)[4], const uint4& colors) {
  const __half2 one = __float2half2_rn(1.0F), scale = __float2half2_rn(-kAlphaScale);
  __half2 weight[Products][2];    // [index in the chain][pixel], two chains each
  __half2 chain[2] = {one, one};  // transmittance of each chain
#pragma unroll
  for (int j = 0; j < Products; ++j) {
    float exponents[4];
    multiply(exponents, basis, coefficients[j]);
#pragma unroll
    for (int p = 0; p < 2; ++p) {
      const __half2 opacity = opacities(exponents[2 * p], exponents[2 * p + 1]);
      weight[j][p] = j == 0 ? opacity : __hmul2(opacity, chain[p]);
      chain[p] = __hfma2(scale, weight[j][p], chain[p]);
    }
  }
  // Over the chains, both pixels at a time: transmittance of the lanes before, and of all.
  const __half2 first = __lows2half2(chain[0], chain[1]);
  const __half2 both = __hmul2(first, __highs2half2(chain[0], chain[1]));
  const __half2 neighbour = __shfl_xor_sync(kFullWarp, both, 1);
  const __half2 pair = __hmul2(both, neighbour);
  const __half2 others = __shfl_xor_sync(kFullWarp, pair, 2);
  const __half2 before = __hmul2((threadIdx.x & 1) != 0 ? neighbour : one, (threadIdx.x & 2) != 0 ? others : one);
  const __half2 low = __hmul2(t, before);    // before the lane's first chain
  const __half2 high = __hmul2(low, first);  // before its second
  t = __hmul2(t, __hmul2(pair, others));
  const __half2 begin[2] = {__lows2half2(low, high), __highs2half2(low, high)};
#pragma unroll
  for (auto& values : weight) {
    for (int p = 0; p < 2; ++p) values[p] = __hmul2(values[p], begin[p]);
  }
  if constexpr (Products == 1) multiply_add(color, weight[0], colors.x);
  if constexpr (Products >= 2) multiply_add(color, weight[0], weight[1], colors.x, colors.y);
  if constexpr (Products == 3) multiply_add(color, weight[2], colors.z);
  if constexpr (Products == 4) multiply_add(color, weight[2], weight[3], colors.z, colors.w);
}

// A warp's pixels of a cell whose first pixel is (x, y).
struct Rows {
  Row rows[kRows];

  __device__ Rows(int x, int y, int width, int height) : rows{Row(0), Row(1)} {
    static_assert(kRows == 2, "both are made above");
    if (x + kTurboCellWidth <= width && y + kTurboCellHeight <= height) return;
    // A pixel outside the image counts as finished.
    const TurboCorner first = first_pixel(threadIdx.x / 32);
    const bool is_left = x + static_cast<int>(first.x + threadIdx.x % 32 / 4) < width;  // pixel g of each row
    const int height_left = height - y - static_cast<int>(first.y);
#pragma unroll
    for (int k = 0; k < kRows; ++k) {
      rows[k].t = __floats2half2_rn(is_left && 2 * k < height_left ? 1.0F : 0.0F,
                                    is_left && 2 * k + 1 < height_left ? 1.0F : 0.0F);
    }
  }
  // Blends gaussians[0 .. n - 1] of the cell. Where it culls, true once all warps' pixels are opaque.
  template <bool Culls>
  __device__ bool blend(const ScreenSplat* splats, const std::uint32_t* gaussians, std::uint32_t n, float x, float y,
                        Staging<Culls>& staging);
  // The thread's own pixel. Call after blend().
  __device__ TurboPixel own_pixel(TurboPixel (&pixels)[kThreads]) const;

 private:
  __device__ bool is_opaque() const {  // the warp's pixels
    std::uint32_t bits = 0;
#pragma unroll
    for (const Row& row : rows) bits |= bits_of(row.t);
    return __any_sync(kFullWarp, (bits & kNotOpaque) != 0) == 0;
  }
};

template <bool Culls>
__device__ inline bool Rows::blend(const ScreenSplat* splats, const std::uint32_t* gaussians, std::uint32_t n, float x,
                                   float y, Staging<Culls>& staging) {
  const std::uint32_t warp = threadIdx.x / 32, lane = threadIdx.x % 32, column = lane % 8;
  if constexpr (Culls) {
    if (threadIdx.x == 0) {
      staging.high(staging.kNone) = {0xE3D0, 0, 0, 0};  // an exponent of -1000
      staging.low(staging.kNone) = staging.color(staging.kNone) = {};
    }
  }
  // What the thread stages of the batch that starts at `begin`. A warp whose part begins at n or later stages nothing.
  std::uint32_t k = 0, next = 0;
  const auto prefetch = [&](std::uint32_t begin) {
    const std::uint32_t first = begin + 32 * warp;
    if (!Culls && first >= n) return;  // where it culls, one more branch would spill
    k = first + (Culls ? 4 : products_of(n - first)) * column + lane / 8;
    next = gaussians[math::min(k, n - 1)];
  };
  prefetch(0);
  bool opaque = Culls && is_opaque();
  for (std::uint32_t begin = 0; begin < n; begin += kThreads) {
    if (begin + 32 * warp < n) stage<Culls>(splats[next], k < n, x, y, staging);
    if (begin + kThreads < n) prefetch(begin + kThreads);
    __syncthreads();
    const std::uint32_t left = math::min(n - begin, static_cast<std::uint32_t>(kThreads));
    std::uint32_t n_blended = left;
    if constexpr (Culls) n_blended = opaque ? 0 : list_touching(staging, left);
    std::uint32_t first = 0;
    const auto blend_next = [&]<int Products>() {
      uint2 coefficients[4];
      uint4 colors;
      if constexpr (Culls) {
        const std::uint32_t at = first + Products * column + lane / 8;
        const std::uint32_t slot = lane / 8 < Products && at < n_blended ? staging.touching[warp][at] : staging.kNone;
        const uint4 high = load_matrices(&staging.high(slot)), low = load_matrices(&staging.low(slot));
        coefficients[0] = {high.x, low.x}, coefficients[1] = {high.y, low.y};
        coefficients[2] = {high.z, low.z}, coefficients[3] = {high.w, low.w};
        colors = load_transposed(&staging.color(slot));
      } else {
        const uint4* const row = staging.rows + staging.kRowsOf32 / 32 * first + lane;
        const uint4 front = load_matrices(row);
        coefficients[0] = {front.x, front.y}, coefficients[1] = {front.z, front.w};
        if constexpr (Products > 2) {
          const uint4 back = load_matrices(row + 32);
          coefficients[2] = {back.x, back.y}, coefficients[3] = {back.z, back.w};
        }
        colors = load_transposed(row + 64);
      }
#pragma unroll
      for (Row& row : rows) row.blend<Products>(coefficients, colors);
      opaque = is_opaque();
      first += 32;
    };
    while (first + 24 < n_blended && !opaque) blend_next.template operator()<4>();
    if (first < n_blended && !opaque) {
      const std::uint32_t n_products = products_of(n_blended - first);
      if (n_products == 3) blend_next.template operator()<3>();
      if (n_products == 2) blend_next.template operator()<2>();
      if (n_products == 1) blend_next.template operator()<1>();
    }
    if (!Culls && begin + kThreads >= n) break;
    if (__syncthreads_and(opaque)) return true;
  }
  return false;
}

__device__ inline TurboPixel Rows::own_pixel(TurboPixel (&pixels)[kThreads]) const {
  // Through the warp's part of shared memory: lanes q = 0 hold red and green, q = 1 blue.
  static_assert(sizeof(TurboPixel) == 2 * sizeof(float2));
  const std::uint32_t lane = threadIdx.x % 32, q = lane % 4;
  if (q < 2) {
#pragma unroll
    for (std::uint32_t k = 0; k < kRows; ++k) {
      const Row& row = rows[k];
      float2* const to = reinterpret_cast<float2*>(pixels + (threadIdx.x - lane) + 16 * k + lane / 4) + q;
      to[0] = {row.color[0], q == 0 ? row.color[1] : __low2float(row.t)};
      to[16] = {row.color[2], q == 0 ? row.color[3] : __high2float(row.t)};
    }
  }
  __syncwarp();
  return pixels[threadIdx.x];
}

__device__ inline void store(const TurboBlendArguments& a, int x, int y, const TurboPixel& p) {
  if (x < a.width && y < a.height) {
    store_pixel<false>(a.target, a.background, PitchedPixel{x, y},
                       math::Pixel<float>{p.r, p.g, p.b, 0, p.transmittance}, 0, 0);
  }
}

constexpr const char* kNotLaunched = "a kernel of matrix products could not be launched";

// ---- long cells

constexpr std::uint32_t kPixels = TurboLongCellSizes::kPixels;
static_assert(kPixels == kThreads, "a thread a pixel when segments are joined");

// Leaves a cell's Gaussians after the front to turbo_segment_kernel.
__device__ inline void leave(const TurboBlendArguments& a, const TurboPixel& pixel, std::uint32_t cell, std::uint32_t n,
                             std::uint32_t front) {
  __shared__ std::uint32_t own, first, places[kTurboWaves];
  const TurboArrays& arrays = a.arrays;
  const std::uint32_t left = n - front;
  const std::uint32_t wanted = (left + kTurboMaxSegments - 1) / kTurboMaxSegments;
  const std::uint32_t segment_n = math::max(kTurboSegment, (wanted + 31) / 32 * 32);
  const std::uint32_t n_segments = (left + segment_n - 1) / segment_n;
  if (threadIdx.x == 0) {
    own = atomicAdd(&arrays.state->n_long_cells, 1u);
    first = atomicAdd(&arrays.state->n_segments, n_segments);
    arrays.long_cells[own] = {cell, front, n_segments, segment_n, first, 0, 0, 0, 0, {}};
  }
  if (threadIdx.x < kTurboWaves && n_segments >= 1u << threadIdx.x) {
    const std::uint32_t wave = 1u << threadIdx.x;
    places[threadIdx.x] = atomicAdd(arrays.state->wave_size + threadIdx.x, math::min(wave, n_segments - wave + 1));
  }
  __syncthreads();
  const std::uint64_t capacity = TurboLongCellSizes::of(arrays.cell_capacity).segments;
  for (std::uint32_t k = threadIdx.x; k < n_segments; k += kThreads) {
    const int wave = 31 - __clz(static_cast<int>(k + 1));
    arrays.waves[static_cast<std::uint64_t>(wave) * capacity + places[wave] + k + 1 - (1u << wave)] = {own, k};
    arrays.segment_done[first + k] = 0;
  }
  arrays.long_cell_pixels[std::uint64_t{kPixels} * own + threadIdx.x] = pixel;
}

template <bool Culls>
__device__ inline void blend_cell(const TurboBlendArguments& a, std::uint32_t number, Staging<Culls>& staging) {
  const TurboCell cell = a.arrays.cells[number];
  const int x = static_cast<int>(cell.x), y = static_cast<int>(cell.y);
  if (x >= a.width || y >= a.height) return;
  TurboPixel pixel{0, 0, 0, 1};
  if (cell.n > 0) {
    const std::uint32_t front = Culls ? turbo_front(a.arrays.state->counters.instances) : cell.n;
    Rows rows(x, y, a.width, a.height);
    const bool opaque = rows.blend<Culls>(a.splats, a.arrays.cell_gaussians + cell.begin, math::min(cell.n, front),
                                          static_cast<float>(x), static_cast<float>(y), staging);
    pixel = rows.own_pixel(staging.pixels);
    if (Culls && cell.n > front && !opaque) {
      leave(a, pixel, number, cell.n, front);
      return;
    }
  }
  const TurboCorner own = own_corner();
  store(a, x + static_cast<int>(own.x), y + static_cast<int>(own.y), pixel);
}

__global__ void __launch_bounds__(kThreads, kResident) turbo_tensor_kernel(TurboBlendArguments a) {
  __shared__ Staging<false> staging;
  if (blockIdx.x >= kTurboCells * a.arrays.state->n_long_lists) blend_cell<false>(a, blockIdx.x, staging);
}
// For a filled picture, whose tiles without Gaussians are done.
__global__ void __launch_bounds__(kThreads, kResident) turbo_tensor_sparse_kernel(TurboBlendArguments a) {
  __shared__ Staging<false> staging;
  const std::uint32_t first = kTurboCells * a.arrays.state->n_long_lists, end = kTurboCells * listed_tiles(a.arrays);
  for (std::uint32_t number = first + blockIdx.x; number < end; number += gridDim.x) {
    blend_cell<false>(a, number, staging);
    __syncthreads();
  }
}
__global__ void __launch_bounds__(kThreads, kResident) turbo_tensor_long_kernel(TurboBlendArguments a) {
  __shared__ Staging<true> staging;
  __shared__ std::uint32_t next;
  const std::uint32_t n = kTurboCells * a.arrays.state->n_long_lists;
  for (std::uint32_t number = blockIdx.x; number < n;) {
    // Prefetched: a block's first cell is its own, the others are taken in turn.
    std::uint32_t taken = 0;
    if (threadIdx.x == 0) taken = atomicAdd(&a.arrays.state->n_long_cells_taken, 1u);
    blend_cell<true>(a, number, staging);
    if (threadIdx.x == 0) next = gridDim.x + taken;
    __syncthreads();
    number = next;
    __syncthreads();
  }
}

__device__ inline std::uint32_t read(const std::uint32_t& word) {
  return *static_cast<const volatile std::uint32_t*>(&word);
}
__device__ inline float4* pixels_of(TurboPixel* pixels, std::uint64_t place) {
  return reinterpret_cast<float4*>(pixels + kPixels * place) + threadIdx.x;
}
// `behind` seen through `front`, composited.
__device__ inline float4 over(const float4& front, const float4& behind) {
  return {fmaf(front.w, behind.x, front.x), fmaf(front.w, behind.y, front.y), fmaf(front.w, behind.z, front.z),
          front.w * behind.w};
}
// Makes all threads' writes visible before thread 0's next write.
__device__ inline void publish() {
  __threadfence();
  __syncthreads();
}

// Joins segment k of a wave of n, whose first is `first`, with its neighbours: of two, then of four, ...; the last to
// finish joins both. True once the whole wave is joined, at `first`.
__device__ inline bool join_wave(const TurboArrays& a, std::uint32_t first, std::uint32_t k, std::uint32_t n) {
  __shared__ bool is_second;
  for (std::uint32_t width = 1; width < n; width *= 2) {
    const std::uint32_t left = k & ~(2 * width - 1), right = left + width;
    if (right >= n) continue;
    if (threadIdx.x == 0) is_second = atomicAdd(a.segment_done + first + right, 1u) != 0;
    __syncthreads();
    if (!is_second) return false;
    __threadfence();
    float4* const to = pixels_of(a.segment_pixels, first + left);
    __stcg(to, over(__ldcg(to), __ldcg(pixels_of(a.segment_pixels, first + right))));
    publish();
  }
  return true;
}

// Joins finished waves with the ones before them, as far as none is missing. The last wave, or the first behind which
// nothing shows, ends the cell. One block at a time does it for a cell; which one does not change the result.
__device__ inline void join_waves(const TurboBlendArguments& a, TurboLongCell& cell, std::uint32_t wave) {
  __shared__ bool is_mine;
  __shared__ std::uint32_t done;  // one word for all threads, since it may change between their reads
  const TurboArrays& arrays = a.arrays;
  const TurboCell at = arrays.cells[cell.cell];
  const TurboCorner own = own_corner();
  const int x = static_cast<int>(at.x + own.x), y = static_cast<int>(at.y + own.y);
  const bool is_inside = x < a.width && y < a.height;
  float4* const held = pixels_of(arrays.long_cell_pixels, static_cast<std::uint64_t>(&cell - arrays.long_cells));
  if (threadIdx.x == 0) {
    atomicOr(&cell.waves_done, 1u << wave);
    __threadfence();
  }
  for (bool again = true; again;) {
    if (threadIdx.x == 0) {
      is_mine = atomicCAS(&cell.lock, 0u, 1u) == 0;
      __threadfence();
      done = read(cell.waves_done);
      __threadfence();
    }
    __syncthreads();
    if (!is_mine) return;  // its owner will look again
    std::uint32_t joined = read(cell.n_joined);
    bool is_over = read(cell.is_opaque) != 0;
    if (!is_over) {
      float4 sum = __ldcg(held);
      for (; (done >> joined & 1) != 0 && !is_over; ++joined) {
        const std::uint32_t first = (1u << joined) - 1;
        sum = over(sum, __ldcg(pixels_of(arrays.segment_pixels, cell.first_segment + first)));
        is_over = __syncthreads_and(sum.w < kOpaque || !is_inside) != 0 || 2 * first + 1 >= cell.n_segments;
      }
      if (is_over) store(a, x, y, {sum.x, sum.y, sum.z, sum.w});
      __stcg(held, sum);
    }
    publish();
    if (threadIdx.x == 0) {
      cell.n_joined = joined;
      cell.is_opaque = is_over ? 1 : 0;
      __threadfence();
      atomicExch(&cell.lock, 0u);
      __threadfence();
      is_mine = !is_over && (read(cell.waves_done) >> joined & 1) != 0;
    }
    __syncthreads();
    again = is_mine;
    __syncthreads();
  }
}

__global__ void __launch_bounds__(kThreads, kResident) turbo_segment_kernel(TurboBlendArguments a) {
  __shared__ Staging<true> staging;
  __shared__ TurboSegment segment;
  __shared__ bool is_any, is_wanted;
  const TurboArrays& arrays = a.arrays;
  const std::uint32_t n = arrays.state->n_segments;
  if (n == 0) return;
  const std::uint64_t capacity = TurboLongCellSizes::of(arrays.cell_capacity).segments;
  for (;;) {
    __syncthreads();
    if (threadIdx.x == 0) {
      std::uint32_t place = atomicAdd(&arrays.state->n_segments_taken, 1u), wave = 0;
      is_any = place < n;
      if (is_any) {
        for (; place >= arrays.state->wave_size[wave]; ++wave) place -= arrays.state->wave_size[wave];
        segment = arrays.waves[wave * capacity + place];
        is_wanted = read(arrays.long_cells[segment.long_cell].is_opaque) == 0;
      }
    }
    __syncthreads();
    if (!is_any) return;
    if (!is_wanted) continue;
    TurboLongCell& long_cell = arrays.long_cells[segment.long_cell];
    const std::uint32_t in_cell = segment.in_cell;
    const TurboCell cell = arrays.cells[long_cell.cell];
    const std::uint32_t begin = long_cell.front + in_cell * long_cell.segment_n;
    const int x = static_cast<int>(cell.x), y = static_cast<int>(cell.y);
    Rows rows(x, y, a.width, a.height);
    rows.blend<true>(a.splats, arrays.cell_gaussians + cell.begin + begin,
                     math::min(cell.n - begin, long_cell.segment_n), static_cast<float>(x), static_cast<float>(y),
                     staging);
    TurboPixel* const to = arrays.segment_pixels + std::uint64_t{kPixels} * (long_cell.first_segment + in_cell);
    to[threadIdx.x] = rows.own_pixel(staging.pixels);
    publish();
    const std::uint32_t wave = 31 - static_cast<std::uint32_t>(__clz(static_cast<int>(in_cell + 1)));
    const std::uint32_t first = (1u << wave) - 1;
    if (join_wave(arrays, long_cell.first_segment + first, in_cell - first,
                  math::min(1u << wave, long_cell.n_segments - first))) {
      join_waves(a, long_cell, wave);
    }
  }
}

// ---- pictures that are mostly background

constexpr int kFillThreads = 256;

// Takes rows until none are left, a row a block.
__global__ void __launch_bounds__(kFillThreads) turbo_fill_kernel(TurboBlendArguments a) {
  for (int y = static_cast<int>(blockIdx.x); y < a.height; y += static_cast<int>(gridDim.x)) {
    for (int x = static_cast<int>(threadIdx.x); x < a.width; x += kFillThreads) store(a, x, y, {0, 0, 0, 1});
  }
}

}  // namespace

Status launch_turbo_fill(const TurboBlendArguments& a, Stream stream) {
  const auto n = multiprocessors();
  if (!n) return tl::unexpected(n.error());
  // Few blocks: they saturate memory, and leave room for the stages beside them.
  const std::uint32_t blocks = math::min(2 * *n, static_cast<std::uint32_t>(a.height));
  turbo_fill_kernel<<<blocks, kFillThreads, 0, stream>>>(a);
  return launched("the kernel that fills the picture could not be launched");
}

Status launch_turbo_tensor(const TurboBlendArguments& a, Stream stream) {
  if (a.is_filled) {
    const auto blocks = resident_grid<turbo_tensor_sparse_kernel>(kThreads);
    if (!blocks) return tl::unexpected(blocks.error());
    turbo_tensor_sparse_kernel<<<*blocks, kThreads, 0, stream>>>(a);
  } else {
    turbo_tensor_kernel<<<a.arrays.n_tiles * kTurboCells, kThreads, 0, stream>>>(a);
  }
  return launched(kNotLaunched);
}

Status launch_turbo_tensor_long(const TurboBlendArguments& a, Stream stream) {
  const auto blocks = resident_grid<turbo_tensor_long_kernel>(kThreads);
  if (!blocks) return tl::unexpected(blocks.error());
  turbo_tensor_long_kernel<<<*blocks, kThreads, 0, stream>>>(a);
  return launched(kNotLaunched);
}

Status launch_turbo_segments(const TurboBlendArguments& a, Stream stream) {
  const auto blocks = resident_grid<turbo_segment_kernel>(kThreads);
  if (!blocks) return tl::unexpected(blocks.error());
  turbo_segment_kernel<<<*blocks, kThreads, 0, stream>>>(a);
  return launched(kNotLaunched);
}

}  // namespace rgs::cuda
