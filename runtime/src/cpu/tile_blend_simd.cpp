// tile_blend_simd.cpp - one tile, a row of pixels per vector, compiled for each instruction set and dispatched at run
// time.
// SPDX-License-Identifier: Apache-2.0
//
// Gaussians are the outer loop. The rows that one reaches are found for all 16 at once, so the inner loop visits only
// rows in which something counts, without mispredicted branches. Pixel state stays in the first-level cache (7 KiB a
// tile). A pixel that stops keeps its transmittance in the output and works with 0 instead, which rejects all later
// pairs.

// On x86 AVX-512, AVX2, and the portable fallback for machines from before 2013; elsewhere all targets.
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_SSE4)

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/tile_blend_simd.cpp"  // NOLINT
#include <hwy/foreach_target.h>
//
#include <hwy/cache_control.h>
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "cpu/tile_blend.hpp"

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;
using math::Exp;
using math::Exponent;
using math::kTileSize;

using D = hn::CappedTag<float, kTileSize>;
using DI = hn::RebindToSigned<D>;
using DU = hn::RebindToUnsigned<D>;
using V = hn::Vec<D>;

// 2^p for p in [-126, 1]: 2^round(p) enters as exponent bits, the rest is a minimax polynomial of degree 5 on
// [-1/2, 1/2] with relative error 7.5e-8.
HWY_INLINE V exp2_exact(V p) {
  const D d;
  const DI di;
  const auto n = hn::NearestInt(p);
  const V f = hn::Sub(p, hn::ConvertTo(d, n));
  V e = hn::Set(d, 1.327647199e-03F);
  e = hn::MulAdd(e, f, hn::Set(d, 9.675541334e-03F));
  e = hn::MulAdd(e, f, hn::Set(d, 5.550713273e-02F));
  e = hn::MulAdd(e, f, hn::Set(d, 2.402211972e-01F));
  e = hn::MulAdd(e, f, hn::Set(d, 6.931469671e-01F));
  e = hn::MulAdd(e, f, hn::Set(d, 1.000000072F));
  return hn::BitCast(d, hn::Add(hn::BitCast(di, e), hn::ShiftLeft<23>(n)));
}

// rgs::math::exp2_bits in vectors: the same operations in the same order.
template <Exp E>
HWY_INLINE V exp2_of(V p) {
  if constexpr (E == Exp::exact) {
    return exp2_exact(p);
  } else {
    const D d;
    const DI di;
    const float bias = 8388608.0F * (127.0F - math::exp_sigma<E>());
    return hn::BitCast(d, hn::ConvertTo(di, hn::Add(hn::Mul(p, hn::Set(d, 8388608.0F)), hn::Set(d, bias))));
  }
}

// Exponent (base 2) of one Gaussian in a tile: xx dx^2 + (xy dy + x) dx + (yy dy + y) dy + one.
struct Quadratic {
  float xx, xy, yy;
  float u, v;       // origin of (dx, dy) in tile-local pixels: the mean (direct) or 0 (folded)
  float x, y, one;  // 0 (direct)
  float gain;       // factor of the exponential: opacity (direct) or 1 (folded)
  float cutoff;     // smallest exponent that counts
  float limit;      // largest exponent that counts

  HWY_INLINE float linear(float dy) const { return x + xy * dy; }
  HWY_INLINE float constant(float dy) const { return (yy * dy + y) * dy + one; }
};

template <Exponent X>
HWY_INLINE Quadratic quadratic(const ScreenSplat& s, const TileJob& job) {
  const math::PixelPoint<float> local{s.mean.u - static_cast<float>(job.x), s.mean.v - static_cast<float>(job.y)};
  if constexpr (X == Exponent::direct) {
    const float half = -0.5F * math::kLog2E;
    const float cutoff = math::kLog2AlphaMin - s.log2_opacity;
    return {
        half * s.conic.a, -math::kLog2E * s.conic.b, half * s.conic.c, local.u, local.v, 0, 0, 0, s.opacity, cutoff, 0};
  } else {
    const auto f = math::fold(s.conic, local, s.log2_opacity);
    return {f.xx, f.xy, f.yy, 0, 0, f.x, f.y, f.one, 1, math::kLog2AlphaMin, std::numeric_limits<float>::infinity()};
  }
}

// Rows of the tile, one bit each, in which the exponent reaches the cutoff between the outermost columns. Lanes are
// rows: along a row the quadratic is largest at dx = -linear / (2 xx), clamped to the columns.
HWY_INLINE std::uint32_t rows_reached(const Quadratic& q) {
  const D d;
  const float first = -q.u, last = static_cast<float>(kTileSize - 1) - q.u;
  const float reach = std::max(last, -first);
  const float slack = 1e-3F - 1e-6F * q.xx * reach * reach;  // for rounding of terms that may cancel
  const V cutoff = hn::Set(d, q.cutoff - slack);
  const V top = hn::Set(d, -0.5F / std::min(q.xx, -1e-30F));
  std::uint32_t rows = 0;
  for (std::size_t y = 0; y < static_cast<std::size_t>(kTileSize); y += hn::Lanes(d)) {
    const V dy = hn::Iota(d, static_cast<float>(y) - q.v);
    const V linear = hn::MulAdd(hn::Set(d, q.xy), dy, hn::Set(d, q.x));
    const V constant = hn::MulAdd(hn::MulAdd(hn::Set(d, q.yy), dy, hn::Set(d, q.y)), dy, hn::Set(d, q.one));
    const V dx = hn::Min(hn::Max(hn::Mul(linear, top), hn::Set(d, first)), hn::Set(d, last));
    const V p = hn::MulAdd(hn::MulAdd(hn::Set(d, q.xx), dx, linear), dx, constant);
    std::uint8_t bits[8] = {};
    hn::StoreMaskBits(d, hn::Ge(p, cutoff), bits);
    rows |= (static_cast<std::uint32_t>(bits[0]) | static_cast<std::uint32_t>(bits[1]) << 8) << y;
  }
  return rows;
}

template <Exponent X, Exp E, bool kDetails>
HWY_NOINLINE std::uint64_t blend_tile(const TileJob& job, TilePixels& out) {
  constexpr std::uint32_t kAhead = 6;  // list entries between prefetch and use of a splat
  const D d;
  const DU du;
  const std::size_t lanes = hn::Lanes(d);  // a power of two, at most 16, so rows are whole vectors
  const auto n_list = static_cast<std::uint32_t>(job.list.size());
  HWY_ALIGN float working[kTilePixels];  // transmittance, 0 where the pixel has stopped or lies outside the image
  for (int y = 0; y < kTileSize; ++y) {
    for (int x = 0; x < kTileSize; ++x) {
      const int i = y * kTileSize + x;
      working[i] = x < job.width && y < job.height ? 1.0F : 0.0F;
      out.r[i] = out.g[i] = out.b[i] = out.depth[i] = 0;
      out.transmittance[i] = 1;
      out.evaluated[i] = n_list, out.blended[i] = 0;
    }
  }
  std::uint64_t n_blended = 0;
  std::uint32_t live_rows = (1U << job.height) - 1;
  const V columns = hn::Iota(d, 0);
  const V alpha_max = hn::Set(d, math::kAlphaMax), stop_below = hn::Set(d, math::kTransmittanceMin);
  const V zero = hn::Zero(d), ceiling = hn::Set(d, 1);
  const auto row_is_live = [&](int y) HWY_ATTR {
    V any = zero;
    for (std::size_t x = 0; x < static_cast<std::size_t>(kTileSize); x += lanes) {
      any = hn::Max(any, hn::Load(d, working + static_cast<std::size_t>(y * kTileSize) + x));
    }
    return !hn::AllFalse(d, hn::Gt(any, zero));
  };

  for (std::uint32_t k = 0; k < n_list && live_rows != 0; ++k) {
    if (k + kAhead < n_list) hwy::Prefetch(&job.splats[job.list[k + kAhead]]);
    const ScreenSplat& s = job.splats[job.list[k]];
    const Quadratic q = quadratic<X>(s, job);
    std::uint32_t rows = live_rows & rows_reached(q);
    if (rows == 0) continue;
    const V xx = hn::Set(d, q.xx), cutoff = hn::Set(d, q.cutoff), limit = hn::Set(d, q.limit);
    const V gain = hn::Set(d, q.gain), z = hn::Set(d, s.z);
    const V red = hn::Set(d, s.color.x), green = hn::Set(d, s.color.y), blue = hn::Set(d, s.color.z);
    V weight_sum = zero, weight_largest = zero;
    do {
      const int y = static_cast<int>(hwy::Num0BitsBelowLS1Bit_Nonzero32(rows));
      rows &= rows - 1;
      const float dy = static_cast<float>(y) - q.v;
      const V linear = hn::Set(d, q.linear(dy)), constant = hn::Set(d, q.constant(dy));
      for (std::size_t x = 0; x < static_cast<std::size_t>(kTileSize); x += lanes) {
        const std::size_t i = static_cast<std::size_t>(y * kTileSize) + x;
        const V t = hn::Load(d, working + i);
        const V dx = hn::Add(columns, hn::Set(d, static_cast<float>(x) - q.u));
        const V p = hn::MulAdd(hn::MulAdd(xx, dx, linear), dx, constant);
        const auto counts = hn::And(hn::Gt(t, zero), hn::And(hn::Ge(p, cutoff), hn::Le(p, limit)));
        // A row of a single vector was tested already.
        if (lanes < static_cast<std::size_t>(kTileSize) && hn::AllFalse(d, counts)) continue;
        // Keeps lanes that do not count, and folded exponents that rounding raised above 1, in exp2's domain.
        const V e = exp2_of<E>(hn::Min(hn::Max(p, cutoff), ceiling));
        const V alpha = hn::IfThenElseZero(counts, hn::Min(alpha_max, hn::Mul(gain, e)));
        V after = hn::NegMulAdd(t, alpha, t);
        V weight = hn::Mul(alpha, t);
        auto blends = counts;
        const auto stops = hn::And(counts, hn::Lt(after, stop_below));
        const bool any_stops = !hn::AllFalse(d, stops);
        if (HWY_UNLIKELY(any_stops)) {
          hn::BlendedStore(t, stops, d, out.transmittance + i);
          hn::BlendedStore(hn::Set(du, k + 1), hn::RebindMask(du, stops), du, out.evaluated + i);
          weight = hn::IfThenZeroElse(stops, weight);
          after = hn::IfThenZeroElse(stops, after);
          blends = hn::AndNot(stops, counts);
        }
        hn::Store(after, d, working + i);
        hn::Store(hn::MulAdd(weight, red, hn::Load(d, out.r + i)), d, out.r + i);
        hn::Store(hn::MulAdd(weight, green, hn::Load(d, out.g + i)), d, out.g + i);
        hn::Store(hn::MulAdd(weight, blue, hn::Load(d, out.b + i)), d, out.b + i);
        n_blended += hn::CountTrue(d, blends);
        if constexpr (kDetails) {
          hn::Store(hn::MulAdd(weight, z, hn::Load(d, out.depth + i)), d, out.depth + i);
          // A true lane is all ones, so subtracting the mask counts.
          const auto ones = hn::VecFromMask(du, hn::RebindMask(du, blends));
          hn::Store(hn::Sub(hn::Load(du, out.blended + i), ones), du, out.blended + i);
          weight_sum = hn::Add(weight_sum, weight);
          weight_largest = hn::Max(weight_largest, weight);
        }
        if (HWY_UNLIKELY(any_stops) && !row_is_live(y)) live_rows &= ~(1U << y);
      }
    } while (rows != 0);
    if constexpr (kDetails) {
      if (job.weights != nullptr) {
        job.weights[k] = {hn::GetLane(hn::SumOfLanes(d, weight_sum)), hn::GetLane(hn::MaxOfLanes(d, weight_largest))};
      }
    }
  }
  for (std::size_t i = 0; i < kTilePixels; i += lanes) {
    const V t = hn::Load(d, working + i);
    hn::Store(hn::IfThenElse(hn::Gt(t, zero), t, hn::Load(d, out.transmittance + i)), d, out.transmittance + i);
  }
  return n_blended;
}

template <Exponent X, bool kDetails>
std::uint64_t blend_with(const TileJob& job, TilePixels& out) {
  switch (job.exp) {
    case Exp::paper: return blend_tile<X, Exp::paper, kDetails>(job, out);
    case Exp::zero_mean: return blend_tile<X, Exp::zero_mean, kDetails>(job, out);
    default: return blend_tile<X, Exp::exact, kDetails>(job, out);
  }
}

std::uint64_t blend(const TileJob& job, TilePixels& out) {
  if (job.exponent == Exponent::direct) {
    return job.details ? blend_with<Exponent::direct, true>(job, out) : blend_with<Exponent::direct, false>(job, out);
  }
  return job.details ? blend_with<Exponent::folded, true>(job, out) : blend_with<Exponent::folded, false>(job, out);
}

const char* target_name() {
  return hwy::TargetName(HWY_TARGET);
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {
HWY_EXPORT(blend);
HWY_EXPORT(target_name);

std::uint64_t blend_tile_simd(const TileJob& job, TilePixels& pixels) {
  return HWY_DYNAMIC_DISPATCH(blend)(job, pixels);
}
const char* simd_target_name() {
  return HWY_DYNAMIC_DISPATCH(target_name)();
}

}  // namespace rgs::detail
#endif  // HWY_ONCE
