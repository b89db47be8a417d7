// codec_kernels_impl.hpp - definitions of the loops of codec_kernels.hpp, included once for each instruction set.
// SPDX-License-Identifier: Apache-2.0
//
// RGS_KERNELS_NAMESPACE names the set; the compiler's flags choose it. Nothing but intrinsics and fixed-width types may
// be included here: an inline function of the library compiled with AVX could be the one that the linker keeps.
//
// Integer operations are those of docs/FORMAT.md, mod 2^16; FP32 operations are rounded once each. So every instruction
// set gives the same bits.
#include "codec_kernels.hpp"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace rgs::detail::RGS_KERNELS_NAMESPACE {
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
inline Words subtract(Words a, Words b) {
  return _mm512_sub_epi16(a, b);
}
inline Words low(Words a, Words b) {
  return _mm512_mullo_epi16(a, b);
}
inline Words clamp127(Words a) {
  return _mm512_min_epi16(_mm512_max_epi16(a, _mm512_set1_epi16(-127)), _mm512_set1_epi16(127));
}
template <int kBits>
inline Words shift_right(Words a) {
  return _mm512_srai_epi16(a, kBits);
}
inline Words wrap8(Words a) {
  return _mm512_srai_epi16(_mm512_slli_epi16(a, 8), 8);
}
inline Words high_rounded(Words a, Words b) {
  return _mm512_mulhrs_epi16(a, b);
}
inline Words widen(const void* p) {
  return _mm512_cvtepi8_epi16(_mm256_loadu_si256(static_cast<const __m256i*>(p)));
}
inline void narrow(void* p, Words v) {
  _mm256_storeu_si256(static_cast<__m256i*>(p), _mm512_cvtepi16_epi8(v));
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
inline Words subtract(Words a, Words b) {
  return _mm256_sub_epi16(a, b);
}
inline Words low(Words a, Words b) {
  return _mm256_mullo_epi16(a, b);
}
inline Words clamp127(Words a) {
  return _mm256_min_epi16(_mm256_max_epi16(a, _mm256_set1_epi16(-127)), _mm256_set1_epi16(127));
}
template <int kBits>
inline Words shift_right(Words a) {
  return _mm256_srai_epi16(a, kBits);
}
inline Words wrap8(Words a) {
  return _mm256_srai_epi16(_mm256_slli_epi16(a, 8), 8);
}
inline Words high_rounded(Words a, Words b) {
  return _mm256_mulhrs_epi16(a, b);
}
inline Words widen(const void* p) {
  return _mm256_cvtepi8_epi16(_mm_loadu_si128(static_cast<const __m128i*>(p)));
}
inline void narrow(void* p, Words v) {  // of values that fit
  const __m256i halves = _mm256_permute4x64_epi64(_mm256_packs_epi16(v, v), 0x08);
  _mm_storeu_si128(static_cast<__m128i*>(p), _mm256_castsi256_si128(halves));
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
inline Words subtract(Words a, Words b) {
  return _mm_sub_epi16(a, b);
}
inline Words low(Words a, Words b) {
  return _mm_mullo_epi16(a, b);
}
inline Words clamp127(Words a) {
  return _mm_min_epi16(_mm_max_epi16(a, _mm_set1_epi16(-127)), _mm_set1_epi16(127));
}
template <int kBits>
inline Words shift_right(Words a) {
  return _mm_srai_epi16(a, kBits);
}
inline Words wrap8(Words a) {
  return _mm_srai_epi16(_mm_slli_epi16(a, 8), 8);
}
// (a b + 2^14) >> 15 from the two halves of the product: twice the upper one, and the bits of the lower one above 2^14.
inline Words high_rounded(Words a, Words b) {
  const __m128i lower = _mm_srli_epi16(_mm_mullo_epi16(a, b), 14);  // 0 to 3, in units of 2^14
  return _mm_add_epi16(_mm_slli_epi16(_mm_mulhi_epi16(a, b), 1),
                       _mm_srli_epi16(_mm_add_epi16(lower, _mm_set1_epi16(1)), 1));
}
inline Words widen(const void* p) {
  const __m128i bytes = _mm_loadl_epi64(static_cast<const __m128i*>(p));
  return _mm_srai_epi16(_mm_unpacklo_epi8(_mm_setzero_si128(), bytes), 8);
}
inline void narrow(void* p, Words v) {
  _mm_storel_epi64(static_cast<__m128i*>(p), _mm_packs_epi16(v, v));
}
#else
constexpr int kPortableWidth = 16;
struct Words {
  std::int16_t lane[kPortableWidth];
};
template <class F>
inline Words each(const F& f) {
  Words v;
  for (int i = 0; i < kPortableWidth; ++i) v.lane[i] = static_cast<std::int16_t>(f(i));
  return v;
}
inline Words load(const std::int16_t* p) {
  return each([&](int i) { return p[i]; });
}
inline void save(std::int16_t* p, const Words& v) {
  for (int i = 0; i < kPortableWidth; ++i) p[i] = v.lane[i];
}
inline Words fill(std::int16_t x) {
  return each([&](int) { return x; });
}
inline Words add(const Words& a, const Words& b) {
  return each([&](int i) { return a.lane[i] + b.lane[i]; });
}
inline Words subtract(const Words& a, const Words& b) {
  return each([&](int i) { return a.lane[i] - b.lane[i]; });
}
inline Words high(const Words& a, const Words& b) {
  return each([&](int i) { return (a.lane[i] * b.lane[i]) >> 16; });
}
inline Words low(const Words& a, const Words& b) {
  return each([&](int i) { return a.lane[i] * b.lane[i]; });
}
inline Words high_rounded(const Words& a, const Words& b) {
  return each([&](int i) { return (a.lane[i] * b.lane[i] + 0x4000) >> 15; });
}
inline Words clamp127(const Words& a) {
  return each([&](int i) { return a.lane[i] < -127 ? -127 : a.lane[i] > 127 ? 127 : a.lane[i]; });
}
template <int kBits>
inline Words shift_right(const Words& a) {
  return each([&](int i) { return a.lane[i] >> kBits; });
}
inline Words wrap8(const Words& a) {
  return each([&](int i) { return static_cast<std::int8_t>(a.lane[i]); });
}
inline Words widen(const void* p) {
  return each([&](int i) { return static_cast<const std::int8_t*>(p)[i]; });
}
inline void narrow(void* p, const Words& v) {
  for (int i = 0; i < kPortableWidth; ++i) static_cast<std::int8_t*>(p)[i] = static_cast<std::int8_t>(v.lane[i]);
}
#endif

constexpr int kWidth = static_cast<int>(sizeof(Words) / sizeof(std::int16_t));
constexpr int kVectors = kShLanes / kWidth < 4 ? kShLanes / kWidth : 4;  // sums held in registers at once

template <bool kDecode>
inline void run(ShLanes& lanes, const ShWeights& w, std::uint8_t* residual, std::size_t stride) {
  constexpr int kDegree[16] = {0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3};
  for (int i = 0; i < w.n; ++i) {
    const int channel = sh_channel(i), set = 3 * kDegree[i / 3] + channel;
    const std::int16_t* weight = w.weights + i * (i - 1) / 2;
    std::int8_t* codes = lanes.codes[i - i % 3 + channel];
    std::uint8_t* plane = residual + static_cast<std::size_t>(i) * stride;
    const Words carry = fill(w.carry[i]);
    for (int lane = 0; lane < kShLanes; lane += kVectors * kWidth) {
      // Half the value predicted from the codes before. Rounding down loses half a unit a product: put back first.
      Words base[kVectors];
      for (Words& b : base) b = fill(static_cast<std::int16_t>(i / 2));
      for (int j = 0; j < i; ++j) {
        const Words factor = fill(weight[j]);
        for (int v = 0; v < kVectors; ++v) {
          base[v] = add(base[v], high(load(&lanes.value[j][lane + v * kWidth]), factor));
        }
      }
      for (int v = 0; v < kVectors; ++v) {
        const int at = lane + v * kWidth;
        const Words carried = high(load(&lanes.error[i][at]), carry);
        const Words half = add(base[v], add(carried, carried));
        const Words predicted = clamp127(high_rounded(half, load(&lanes.inverse[set][at])));
        Words code;
        if constexpr (kDecode) {
          code = wrap8(add(widen(plane + at), predicted));
          narrow(codes + at, code);
        } else {
          code = widen(codes + at);
          narrow(plane + at, wrap8(subtract(code, predicted)));
        }
        const Words value = low(code, load(&lanes.step[set][at]));
        save(&lanes.value[i][at], value);
        save(&lanes.error[i][at], subtract(shift_right<1>(value), base[v]));
      }
    }
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

// FP16 to FP32 by re-biasing the exponent; infinity and NaN become numbers of 2^16 and above, which no unit quaternion
// has either. The root is 0 or from 2^-12 to 1, a normal FP16 number.
void unit_w(const std::uint8_t* xyz, std::size_t stride, int count, std::uint16_t* w) {
  for (int i = 0; i < count; ++i) {
    float squared[3];
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint8_t* plane = xyz + 2 * k * stride + i;
      const std::uint32_t bits = static_cast<std::uint32_t>((plane[0] | plane[stride] << 8) & 0x7FFF) << 13;
      float x;
      __builtin_memcpy(&x, &bits, sizeof x);
      x *= 0x1p112f;
      squared[k] = x * x;
    }
    const float rest = 1.f - ((squared[0] + squared[1]) + squared[2]);
    const float root = __builtin_sqrtf(rest > 0.f ? rest : 0.f);
    std::uint32_t bits;
    __builtin_memcpy(&bits, &root, sizeof bits);
    const std::uint32_t half = (bits + 0xFFFu + (bits >> 13 & 1u) - 0x38000000u) >> 13;
    w[i] = static_cast<std::uint16_t>(rest > 0.f ? half : 0u);
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

const CodecKernels kKernels = {decode, encode, store, unit_w, correlate};

}  // namespace rgs::detail::RGS_KERNELS_NAMESPACE
