// codec_kernels.cpp - the loops of codec_kernels.hpp, compiled for each instruction set and dispatched at run time.
// SPDX-License-Identifier: Apache-2.0
//
// Integer operations are those of docs/format/FORMAT.md, mod 2^16; FP32 operations are rounded once each. So every
// instruction set gives the same bits.

// Arrays hold sums of vectors, so vectors need a size at compile time.
#define HWY_DISABLED_TARGETS (HWY_SSE4 | HWY_SVE | HWY_SVE2 | HWY_SVE_256 | HWY_SVE2_128 | HWY_RVV)

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "packed/codec_kernels.cpp"  // NOLINT
#include <hwy/foreach_target.h>
//
#include <hwy/highway.h>

#include "packed/codec_kernels.hpp"

HWY_BEFORE_NAMESPACE();
namespace rgs::detail {
namespace HWY_NAMESPACE {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

using D16 = hn::CappedTag<std::int16_t, kShLanes>;
using D8 = hn::Rebind<std::int8_t, D16>;
using Words = hn::Vec<D16>;
constexpr D16 d16;
constexpr D8 d8;

constexpr int kWidth = static_cast<int>(hn::MaxLanes(d16));
constexpr int kVectors = kShLanes / kWidth < 4 ? kShLanes / kWidth : 4;  // sums kept in registers at once

HWY_INLINE Words clamp127(Words a) {
  return hn::Min(hn::Max(a, hn::Set(d16, std::int16_t{-127})), hn::Set(d16, std::int16_t{127}));
}
HWY_INLINE Words wrap8(Words a) {
  return hn::ShiftRight<8>(hn::ShiftLeft<8>(a));
}
HWY_INLINE Words widen(const std::int8_t* p) {
  return hn::PromoteTo(d16, hn::LoadU(d8, p));
}
HWY_INLINE void narrow(std::int8_t* p, Words v) {  // values must fit
  hn::StoreU(hn::DemoteTo(d8, v), d8, p);
}

template <bool kDecode>
HWY_INLINE void run(ShLanes& lanes, const ShWeights& w, std::int8_t* residual, std::size_t stride) {
  constexpr int kDegree[16] = {0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3};
  for (int i = 0; i < w.n; ++i) {
    const int channel = sh_channel(i), set = 3 * kDegree[i / 3] + channel;
    const std::int16_t* weight = w.weights + i * (i - 1) / 2;
    std::int8_t* codes = lanes.codes[i - i % 3 + channel];
    std::int8_t* plane = residual + static_cast<std::size_t>(i) * stride;
    const Words carry = hn::Set(d16, w.carry[i]);
    for (int lane = 0; lane < kShLanes; lane += kVectors * kWidth) {
      // Half the prediction from earlier codes. Rounding down loses half a unit a product, added back first.
      Words base[kVectors];
      for (Words& b : base) b = hn::Set(d16, static_cast<std::int16_t>(i / 2));
      for (int j = 0; j < i; ++j) {
        const Words factor = hn::Set(d16, weight[j]);
        for (int v = 0; v < kVectors; ++v) {
          const Words value = hn::LoadU(d16, &lanes.value[j][lane + v * kWidth]);
          base[v] = hn::Add(base[v], hn::MulHigh(value, factor));
        }
      }
      for (int v = 0; v < kVectors; ++v) {
        const int at = lane + v * kWidth;
        const Words carried = hn::MulHigh(hn::LoadU(d16, &lanes.error[i][at]), carry);
        const Words half = hn::Add(base[v], hn::Add(carried, carried));
        const Words predicted = clamp127(hn::MulFixedPoint15(half, hn::LoadU(d16, &lanes.inverse[set][at])));
        Words code;
        if constexpr (kDecode) {
          code = wrap8(hn::Add(widen(plane + at), predicted));
          narrow(codes + at, code);
        } else {
          code = widen(codes + at);
          narrow(plane + at, wrap8(hn::Sub(code, predicted)));
        }
        const Words value = hn::Mul(code, hn::LoadU(d16, &lanes.step[set][at]));
        hn::StoreU(value, d16, &lanes.value[i][at]);
        hn::StoreU(hn::Sub(hn::ShiftRight<1>(value), base[v]), d16, &lanes.error[i][at]);
      }
    }
  }
}

void decode(ShLanes& lanes, const ShWeights& weights, const std::uint8_t* residual, std::size_t stride) {
  run<true>(lanes, weights, const_cast<std::int8_t*>(reinterpret_cast<const std::int8_t*>(residual)), stride);
}

void encode(ShLanes& lanes, const ShWeights& weights, std::uint8_t* residual, std::size_t stride) {
  run<false>(lanes, weights, reinterpret_cast<std::int8_t*>(residual), stride);
}

#if HWY_TARGET != HWY_SCALAR
// Four rounds of interleaving with the vector half a block away transpose 16 x 16 bytes.
HWY_INLINE void transpose(const std::int8_t* from, std::size_t from_stride, std::int8_t* to, std::size_t to_stride) {
  constexpr hn::Full128<std::int8_t> d;
  hn::Vec<hn::Full128<std::int8_t>> x[16], y[16];
  for (std::size_t i = 0; i < 16; ++i) x[i] = hn::LoadU(d, from + i * from_stride);
  for (int round = 0; round < 4; ++round) {
    for (int i = 0; i < 8; ++i) {
      y[2 * i] = hn::InterleaveLower(d, x[i], x[i + 8]);
      y[2 * i + 1] = hn::InterleaveUpper(d, x[i], x[i + 8]);
    }
    for (int i = 0; i < 16; ++i) x[i] = y[i];
  }
  for (std::size_t i = 0; i < 16; ++i) hn::StoreU(x[i], d, to + i * to_stride);
}

// One instruction sums the products of a pair; four vectors of sums stay in registers.
void mix(const std::int16_t* pairs, const std::int16_t* matrix, int n_pairs, int n_out, std::int32_t* sums) {
  using D32 = hn::RepartitionToWide<D16>;
  constexpr D32 d32;
  constexpr int kPart = 2 * kShLanes / kWidth < 4 ? 2 * kShLanes / kWidth : 4;
  for (int out = 0; out < n_out; ++out, matrix += 2 * n_pairs, sums += kShLanes) {
    for (int part = 0; part < 2 * kShLanes; part += kPart * kWidth) {
      hn::Vec<D32> even[kPart], odd[kPart];  // on x86 both products of a pair go to `even`
      for (int v = 0; v < kPart; ++v) even[v] = odd[v] = hn::Zero(d32);
      for (int p = 0; p < n_pairs; ++p) {
        const std::int16_t* from = pairs + 2 * kShLanes * p + part;
        std::int32_t pair;
        __builtin_memcpy(&pair, matrix + 2 * p, sizeof pair);
        const Words weights = hn::BitCast(d16, hn::Set(d32, pair));
        for (int v = 0; v < kPart; ++v) {
          even[v] = hn::ReorderWidenMulAccumulate(d32, hn::LoadU(d16, from + v * kWidth), weights, even[v], odd[v]);
        }
      }
      for (int v = 0; v < kPart; ++v) {
        hn::StoreU(hn::RearrangeToOddPlusEven(even[v], odd[v]), d32, sums + (part + v * kWidth) / 2);
      }
    }
  }
}
#else
HWY_INLINE void transpose(const std::int8_t* from, std::size_t from_stride, std::int8_t* to, std::size_t to_stride) {
  for (std::size_t i = 0; i < 16; ++i) {
    for (std::size_t j = 0; j < 16; ++j) to[i * to_stride + j] = from[j * from_stride + i];
  }
}

void mix(const std::int16_t* pairs, const std::int16_t* matrix, int n_pairs, int n_out, std::int32_t* sums) {
  for (int out = 0; out < n_out; ++out, matrix += 2 * n_pairs, sums += kShLanes) {
    for (int lane = 0; lane < kShLanes; ++lane) {
      std::uint32_t sum = 0;
      for (int p = 0; p < n_pairs; ++p) {
        const std::int16_t* pair = pairs + 2 * (kShLanes * p + lane);
        sum += static_cast<std::uint32_t>(pair[0] * matrix[2 * p]) +
               static_cast<std::uint32_t>(pair[1] * matrix[2 * p + 1]);
      }
      sums[lane] = static_cast<std::int32_t>(sum);
    }
  }
}
#endif

void store(const ShLanes& lanes, int n, int count, std::int8_t* rows, std::size_t lane_bytes) {
  if (n == kShMaxCodes && count == kShLanes) {
    for (int lane = 0; lane < kShLanes; lane += 16) {
      std::int8_t* to = rows + static_cast<std::size_t>(lane) * lane_bytes;
      for (int code = 0; code < kShMaxCodes; code += 16) {
        transpose(&lanes.codes[code][lane], kShLanes, to + code, lane_bytes);
      }
    }
    return;
  }
  for (int lane = 0; lane < count; ++lane) {
    std::int8_t* row = rows + static_cast<std::size_t>(lane) * lane_bytes;
    for (int code = 0; code < n; ++code) row[code] = lanes.codes[code][lane];
  }
}

// The compiler vectorises this and correlate().
//
void unit_w(const std::uint8_t* xyz, std::size_t stride, int count, std::uint16_t* w) {
  for (int i = 0; i < count; ++i) {
    const auto half = [&](std::size_t k) {
      const std::uint8_t* plane = xyz + 2 * k * stride + i;
      return static_cast<std::uint16_t>(plane[0] | plane[stride] << 8);
    };
    w[i] = rgs::unit_w(half(0), half(1), half(2));
  }
}

void correlate(const float* a, const float* b, int n, float* same, float* lagged) {
  for (int i = 0; i < n; ++i) {
    const float x = a[i];
    for (int j = 0; j < n; ++j) same[i * n + j] += x * a[j];
    for (int j = 0; j < n; ++j) lagged[i * n + j] += x * b[j];
  }
}

}  // namespace

const CodecKernels& kernels() {
  static constexpr CodecKernels kKernels = {decode, encode, store, unit_w, mix, correlate};
  return kKernels;
}

}  // namespace HWY_NAMESPACE
}  // namespace rgs::detail
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace rgs::detail {
HWY_EXPORT(kernels);

const CodecKernels& codec_kernels() {
  return HWY_DYNAMIC_DISPATCH(kernels)();
}

}  // namespace rgs::detail
#endif  // HWY_ONCE
