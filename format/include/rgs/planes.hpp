// planes.hpp - Codec::planes on values, for words, geometry and SH, on host and device; docs/format/FORMAT.md "Coded
// sections". Loops over frames: format/src/packed on the host, kernels/src/common/unpack.cu on the device.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

#include "rgs/api.hpp"
#include "rgs/hd.hpp"
#include "rgs/layout.hpp"
#include "rgs/quantize.hpp"

// For arrays in device registers, whose indices must be compile-time constants.
#if defined(__CUDA_ARCH__)
#define RGS_UNROLL _Pragma("unroll")
#else
#define RGS_UNROLL
#endif

namespace RGS_API rgs {

// ---- words ----------------------------------------------------------------------------------------------------------

/// Bits of an FP32 number to an integer of the same order, and back.
RGS_HD constexpr std::uint32_t ordered_key(std::uint32_t bits) {
  return (bits & 0x80000000u) != 0 ? ~bits : bits | 0x80000000u;
}
RGS_HD constexpr std::uint32_t bits_of_key(std::uint32_t key) {
  return (key & 0x80000000u) != 0 ? key & 0x7FFFFFFFu : ~key;
}

/// Maps small differences of either sign to small numbers, and back; mod 2^32 and 2^16.
RGS_HD constexpr std::uint32_t fold(std::uint32_t difference) {
  return difference << 1 ^ (0u - (difference >> 31));
}
RGS_HD constexpr std::uint32_t unfold(std::uint32_t folded) {
  return folded >> 1 ^ (0u - (folded & 1u));
}
RGS_HD constexpr std::uint16_t fold16(std::uint16_t difference) {
  return static_cast<std::uint16_t>(difference * 2u ^ (0u - (difference >> 15)));
}
RGS_HD constexpr std::uint16_t unfold16(std::uint16_t folded) {
  return static_cast<std::uint16_t>((folded >> 1) ^ (0u - (folded & 1u)));
}

// ---- geometry --------------------------------------------------------------------------------------------------------

/// w of the unit quaternion with the FP16 components x, y, z, as FP16; 0 if there is none. Every operation is rounded
/// once: compile callers without contraction. Infinity and NaN count as numbers of 2^16 and above, which no unit
/// quaternion has either. The root is 0 or from 2^-12 to 1, a normal FP16 number.
RGS_HD inline std::uint16_t unit_w(std::uint16_t x, std::uint16_t y, std::uint16_t z) {
  const auto squared = [](std::uint16_t half) {
    const float value = detail::float_of(static_cast<std::uint32_t>(half & 0x7FFF) << 13) * 0x1p112f;
    return value * value;
  };
  const float rest = 1.f - ((squared(x) + squared(y)) + squared(z));
  const float root = sqrtf(rest > 0.f ? rest : 0.f);
  const std::uint32_t bits = detail::bits_of(root);
  const std::uint32_t half = (bits + 0xFFFu + (bits >> 13 & 1u) - 0x38000000u) >> 13;
  return static_cast<std::uint16_t>(rest > 0.f ? half : 0u);
}

// ---- SH --------------------------------------------------------------------------------------------------------------

/// Lanes that walk a frame side by side.
inline constexpr int kShLanes = 64;

/// Green first: it predicts the others best.
RGS_HD constexpr int sh_channel(int i) {
  return i % 3 == 0 ? 1 : (i % 3 == 1 ? 0 : 2);
}

/// 2^16 / step, rounded down; 0 for steps below 3, which predict nothing.
RGS_HD constexpr std::int16_t sh_inverse_step(std::int16_t step) {
  return static_cast<std::int16_t>(step < 3 ? 0 : 65536 / step);
}

/// Bytes of the weights at the start of a frame's content: n (n - 1) / 2 + n.
RGS_HD constexpr std::uint32_t sh_weight_bytes(int n_codes) {
  return static_cast<std::uint32_t>(n_codes * (n_codes + 1) / 2);
}

/// A chunk's steps by degree and channel, in 1/256 of the frame's largest step of the degree: 0 to 256.
struct RelativeShSteps {
  std::int16_t step[12];
};

/// A frame's predictor as the device keeps it, in 32-bit words: times 2^8, so that the high half of its product with a
/// 16-bit number times 2^16 is the specification's product.
template <int kDegree>
struct alignas(16) ShPredictor {  // four entries are one load
  static constexpr int kCodes = 3 * (kDegree + 1) * (kDegree + 1);
  static constexpr std::size_t kSlots = static_cast<std::size_t>((kCodes + 3) / 4 * 4);
  std::int32_t weight[kSlots][kSlots];  ///< [i][j]: contribution of code i to the prediction of code j > i; 0 elsewhere
  std::int32_t carry[kSlots];           ///< contribution of a code's own error on the Gaussian before

  /// Entry `at` of weight and carry, from the weights of the frame's content.
  RGS_HD static std::int32_t weight_at(const std::uint8_t* content, int i, int j) {
    return i < j && j < kCodes ? widened(content[j * (j - 1) / 2 + i]) : 0;
  }
  RGS_HD static std::int32_t carry_at(const std::uint8_t* content, int i) {
    return i < kCodes ? widened(content[kCodes * (kCodes - 1) / 2 + i]) : 0;
  }

 private:
  RGS_HD static std::int32_t widened(std::uint8_t byte) {
    return static_cast<std::int32_t>(static_cast<std::int8_t>(byte)) * 256;
  }
};

namespace detail {

/// floor(a b / 2^32)
RGS_HD inline std::int32_t product_high(std::int32_t a, std::int32_t b) {
#if defined(__CUDA_ARCH__)
  return __mulhi(a, b);
#else
  return static_cast<std::int32_t>(static_cast<std::int64_t>(a) * b >> 32);
#endif
}
/// Forces loads to be repeated instead of kept: the device has fewer registers than a frame has weights.
RGS_HD inline void forget_loads() {
#if defined(__CUDA_ARCH__)
  asm volatile("" ::: "memory");
#endif
}
/// The lower 16 bits, sign-extended.
RGS_HD inline std::int32_t wrap16(std::int32_t value) {
  return static_cast<std::int16_t>(static_cast<std::uint16_t>(value));
}

}  // namespace detail

/// Codes of one Gaussian. residual(i): of code i; error: of the lane's Gaussian before, 0 if none, replaced by this
/// one's; row: the codes as in SHI8, four to a word.
template <int kDegree, class Residual>
RGS_HD inline void decode_sh_row(const ShPredictor<kDegree>& predictor, const Residual& residual,
                                 const std::int16_t step[12], const std::int16_t inverse[12], std::int32_t* error,
                                 std::uint32_t* row) {
  using detail::product_high;
  using detail::wrap16;
  constexpr int kCodes = ShPredictor<kDegree>::kCodes;
  constexpr std::size_t kSlots = ShPredictor<kDegree>::kSlots, kWords = kSlots / 4;
  std::int32_t base[kSlots];  // half of what earlier codes predict
  RGS_UNROLL
  for (int i = 0; i < kCodes; ++i) base[i] = i / 2;
  RGS_UNROLL
  for (std::size_t i = 0; i < kWords; ++i) row[i] = 0;
  RGS_UNROLL
  for (int i = 0; i < kCodes; ++i) {
    const int set = 3 * sh_degree_of(i / 3) + sh_channel(i), byte = i - i % 3 + sh_channel(i);
    const std::int32_t before = wrap16(base[i]);
    const std::int32_t half = wrap16(before + 2 * product_high(error[i] * 65536, predictor.carry[i]));
    const std::int32_t guess = (half * inverse[set] + (1 << 14)) >> 15;
    const std::int32_t limited = guess < -127 ? -127 : (guess > 127 ? 127 : guess);
    const auto code = static_cast<std::int8_t>(static_cast<std::uint8_t>(residual(i) + limited));
    const std::int32_t value = code * step[set];
    error[i] = wrap16((value >> 1) - before);
    row[byte / 4] |= static_cast<std::uint32_t>(static_cast<std::uint8_t>(code)) << (8 * (byte % 4));
    RGS_UNROLL
    for (int j = i + 1; j < kCodes; ++j) base[j] += product_high(value * 65536, predictor.weight[i][j]);
  }
}

/// A frame of SHI8 after Zstandard.
struct ShPlanes {
  const std::uint8_t* planes;    ///< [codes, n_rows] residuals, after the weights
  const RelativeShSteps* steps;  ///< of each chunk in the frame
  std::uint32_t n_rows;
  std::uint32_t chunk_rows;  ///< Gaussians a chunk
};

/// Decodes the Gaussians of one of the kShLanes lanes to rows [n_rows, sh_bytes].
template <int kDegree>
RGS_HD inline void decode_sh_lane(const ShPredictor<kDegree>& predictor, const ShPlanes& frame, std::uint32_t lane,
                                  std::uint32_t* rows) {
  constexpr int kCodes = ShPredictor<kDegree>::kCodes;
  constexpr std::size_t kSlots = ShPredictor<kDegree>::kSlots, kWords = kSlots / 4;
  constexpr std::uint32_t kLanes = kShLanes;
  const std::uint32_t rows_a_lane = frame.n_rows / kLanes;
  const std::uint32_t n_steps = rows_a_lane + (lane < frame.n_rows % kLanes ? 1 : 0);
  std::int32_t error[kSlots];
  RGS_UNROLL
  for (int i = 0; i < kCodes; ++i) error[i] = 0;
  std::int16_t step[12] = {}, inverse[12] = {};
  std::uint32_t chunk_end = 0;  // of their chunk
  for (std::uint32_t k = 0; k < n_steps; ++k) {
    detail::forget_loads();
    const std::uint32_t position = k * kLanes + lane, row = k < rows_a_lane ? lane * rows_a_lane + k : position;
    if (row >= chunk_end) {
      const std::uint32_t chunk = row / frame.chunk_rows;
      chunk_end = (chunk + 1) * frame.chunk_rows;
      RGS_UNROLL
      for (int s = 0; s < 12; ++s) {
        step[s] = frame.steps[chunk].step[s];
        inverse[s] = sh_inverse_step(step[s]);
      }
    }
    const std::uint8_t* const plane = frame.planes + position;
    const auto residual = [&](int i) {
      return static_cast<std::int32_t>(plane[static_cast<std::size_t>(i) * frame.n_rows]);
    };
    std::uint32_t words[kWords];
    decode_sh_row<kDegree>(predictor, residual, step, inverse, error, words);
    RGS_UNROLL
    for (std::size_t i = 0; i < kWords; ++i) rows[std::size_t{row} * kWords + i] = words[i];
  }
}

}  // namespace rgs

#undef RGS_UNROLL
