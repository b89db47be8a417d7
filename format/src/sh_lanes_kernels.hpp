// sh_lanes_kernels.hpp - definitions of the loops of sh_lanes.hpp, included once for each instruction set.
// SPDX-License-Identifier: Apache-2.0
//
// RGS_LANES_NAMESPACE names the set; the compiler's flags choose it. Nothing but intrinsics and fixed-width types may
// be included here: an inline function of the library compiled with AVX could be the one that the linker keeps.
//
// Integer products keep their upper 16 bits, which rounds down; all sums are mod 2^16; FP32 operations are one rounding
// each. So every instruction set gives the same bits.
#include "sh_lanes.hpp"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace rgs::detail::RGS_LANES_NAMESPACE {
namespace {

#if defined(__AVX512BW__)
using Words = __m512i;
inline Words load(const std::int16_t* p) {
  return _mm512_loadu_si512(p);
}
inline void save(std::int16_t* p, Words v) {
  _mm512_storeu_si512(p, v);
}
inline Words fill(std::int16_t v) {
  return _mm512_set1_epi16(v);
}
inline Words add(Words a, Words b) {
  return _mm512_add_epi16(a, b);
}
inline Words high(Words a, Words b) {
  return _mm512_mulhi_epi16(a, b);
}
#elif defined(__AVX2__)
using Words = __m256i;
inline Words load(const std::int16_t* p) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
}
inline void save(std::int16_t* p, Words v) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), v);
}
inline Words fill(std::int16_t v) {
  return _mm256_set1_epi16(v);
}
inline Words add(Words a, Words b) {
  return _mm256_add_epi16(a, b);
}
inline Words high(Words a, Words b) {
  return _mm256_mulhi_epi16(a, b);
}
#elif defined(__x86_64__)
using Words = __m128i;
inline Words load(const std::int16_t* p) {
  return _mm_loadu_si128(reinterpret_cast<const __m128i*>(p));
}
inline void save(std::int16_t* p, Words v) {
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p), v);
}
inline Words fill(std::int16_t v) {
  return _mm_set1_epi16(v);
}
inline Words add(Words a, Words b) {
  return _mm_add_epi16(a, b);
}
inline Words high(Words a, Words b) {
  return _mm_mulhi_epi16(a, b);
}
#else
struct Words {
  std::int16_t lane[8];
};
inline Words load(const std::int16_t* p) {
  Words v;
  for (int i = 0; i < 8; ++i) v.lane[i] = p[i];
  return v;
}
inline void save(std::int16_t* p, Words v) {
  for (int i = 0; i < 8; ++i) p[i] = v.lane[i];
}
inline Words fill(std::int16_t x) {
  Words v;
  for (std::int16_t& lane : v.lane) lane = x;
  return v;
}
inline Words add(Words a, Words b) {
  for (int i = 0; i < 8; ++i) a.lane[i] = static_cast<std::int16_t>(a.lane[i] + b.lane[i]);
  return a;
}
inline Words high(Words a, Words b) {
  for (int i = 0; i < 8; ++i) a.lane[i] = static_cast<std::int16_t>((a.lane[i] * b.lane[i]) >> 16);
  return a;
}
#endif

constexpr int kWidth = static_cast<int>(sizeof(Words) / sizeof(std::int16_t));
constexpr int kVectors = kShLanes / kWidth < 4 ? kShLanes / kWidth : 4;  // sums held in registers at once

// Half the predicted value from the codes before `i`. Rounding down loses half a unit a product, which is put back.
inline void predict(const ShLanes& lanes, const ShWeights& w, int i, std::int16_t* out) {
  const std::int16_t* weight = w.weights + i * (i - 1) / 2;
  for (int lane = 0; lane < kShLanes; lane += kVectors * kWidth) {
    Words sum[kVectors];
    for (Words& s : sum) s = fill(static_cast<std::int16_t>(i / 2));
    for (int j = 0; j < i; ++j) {
      const Words factor = fill(weight[j]);
      for (int v = 0; v < kVectors; ++v) sum[v] = add(sum[v], high(load(&lanes.value[j][lane + v * kWidth]), factor));
    }
    for (int v = 0; v < kVectors; ++v) save(out + lane + v * kWidth, sum[v]);
  }
}

template <bool kDecode>
inline void run(ShLanes& lanes, const ShWeights& w, std::uint8_t* residual, std::size_t stride) {
  constexpr int kDegree[16] = {0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3};
  alignas(64) std::int16_t base[kShLanes];
  alignas(64) std::int32_t code[kShLanes];
  for (int i = 0; i < w.n; ++i) {
    const int channel = sh_channel(i), set = 3 * kDegree[i / 3] + channel;
    predict(lanes, w, i, base);
    std::int16_t *value = lanes.value[i], *error = lanes.error[i];
    const std::int16_t* step = lanes.step[set];
    const float* inverse = lanes.inverse[set];
    std::int8_t* codes = lanes.codes[i - i % 3 + channel];
    std::uint8_t* plane = residual + static_cast<std::size_t>(i) * stride;
    const int carry = w.carry[i];
    for (int l = 0; l < kShLanes; ++l) {
      const auto half = static_cast<std::int16_t>(base[l] + 2 * ((error[l] * carry) >> 16));
      float p = static_cast<float>(half) * inverse[l];
      p = p < -127.f ? -127.f : p;
      p = p > 127.f ? 127.f : p;
      code[l] = static_cast<std::int32_t>((p + 12582912.f) - 12582912.f);  // to nearest, ties to even
    }
    if constexpr (kDecode) {
      for (int l = 0; l < kShLanes; ++l) codes[l] = static_cast<std::int8_t>(plane[l] + code[l]);
    } else {
      for (int l = 0; l < kShLanes; ++l) plane[l] = static_cast<std::uint8_t>(codes[l] - code[l]);
    }
    for (int l = 0; l < kShLanes; ++l) value[l] = static_cast<std::int16_t>(codes[l] * step[l]);
    for (int l = 0; l < kShLanes; ++l) error[l] = static_cast<std::int16_t>((value[l] >> 1) - base[l]);
  }
}

void decode(ShLanes& lanes, const ShWeights& weights, const std::uint8_t* residual, std::size_t stride) {
  run<true>(lanes, weights, const_cast<std::uint8_t*>(residual), stride);
}

void encode(ShLanes& lanes, const ShWeights& weights, std::uint8_t* residual, std::size_t stride) {
  run<false>(lanes, weights, residual, stride);
}

#if defined(__x86_64__)
// Four rounds of interleaving with the vector half the block away transpose 16 x 16 bytes.
inline void transpose(const std::int8_t* from, std::size_t from_stride, std::int8_t* to, std::size_t to_stride) {
  __m128i x[16], y[16];
  for (int i = 0; i < 16; ++i) {
    x[i] = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from + static_cast<std::size_t>(i) * from_stride));
  }
  for (int round = 0; round < 4; ++round) {
    for (int i = 0; i < 8; ++i) {
      y[2 * i] = _mm_unpacklo_epi8(x[i], x[i + 8]);
      y[2 * i + 1] = _mm_unpackhi_epi8(x[i], x[i + 8]);
    }
    for (int i = 0; i < 16; ++i) x[i] = y[i];
  }
  for (int i = 0; i < 16; ++i) {
    _mm_storeu_si128(reinterpret_cast<__m128i*>(to + static_cast<std::size_t>(i) * to_stride), x[i]);
  }
}
#else
inline void transpose(const std::int8_t* from, std::size_t from_stride, std::int8_t* to, std::size_t to_stride) {
  for (std::size_t i = 0; i < 16; ++i) {
    for (std::size_t j = 0; j < 16; ++j) to[i * to_stride + j] = from[j * from_stride + i];
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

void correlate(const float* a, const float* b, int n, float* same, float* lagged) {
  for (int i = 0; i < n; ++i) {
    const float x = a[i];
    for (int j = 0; j < n; ++j) same[i * n + j] += x * a[j];
    for (int j = 0; j < n; ++j) lagged[i * n + j] += x * b[j];
  }
}

}  // namespace

const ShKernels kKernels = {decode, encode, store, correlate};

}  // namespace rgs::detail::RGS_LANES_NAMESPACE
