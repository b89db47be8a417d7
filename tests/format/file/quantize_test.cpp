// quantize_test.cpp - the quantiser against its bounds, and FP16 conversion against the compiler's.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/quantize.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "golden_scenes.hpp"

using namespace rgs;
using rgs::test::SplitMix;

namespace {

constexpr std::uint64_t kSeed = 20260721;

float ulp(float x) {
  return std::nextafter(std::abs(x), std::numeric_limits<float>::infinity()) - std::abs(x);
}

// Random significand, exponent from low to high.
float random_magnitude(SplitMix& random, int low, int high) {
  const auto significand = static_cast<double>(random.below(1u << 24)) * 0x1p-24 + 1;
  return static_cast<float>(
      std::ldexp(significand, low + static_cast<int>(random.below(static_cast<std::uint64_t>(high - low)))));
}

}  // namespace

#ifdef RGS_HAS_FLOAT16
namespace {

std::uint16_t compiler_half(float value) {
  return std::bit_cast<std::uint16_t>(static_cast<_Float16>(value));
}

// Reports and returns false where the two conversions differ.
bool same_half(std::uint32_t bits) {
  const float value = std::bit_cast<float>(bits);
  const std::uint16_t ours = half_from_float(value), theirs = compiler_half(value);
  if (ours == theirs) return true;
  MESSAGE("float bits " << bits << ": " << ours << ", not " << theirs);
  return false;
}

}  // namespace

TEST_CASE("every FP16 converts to the compiler's float") {
  bool same = true;
  for (std::uint32_t half = 0; half < 65536 && same; ++half) {
    const float theirs = static_cast<float>(std::bit_cast<_Float16>(static_cast<std::uint16_t>(half)));
    const float ours = float_from_half(static_cast<std::uint16_t>(half));
    same = std::bit_cast<std::uint32_t>(ours) == std::bit_cast<std::uint32_t>(theirs);
    if (!same) MESSAGE("half bits " << half);
  }
  CHECK(same);
}

TEST_CASE("floats convert to the compiler's FP16") {
  bool same = true;
  for (std::uint64_t bits = 0; bits < std::uint64_t{1} << 32 && same; bits += 97) {
    same = same_half(static_cast<std::uint32_t>(bits));
  }
  CHECK(same);
}

TEST_CASE("floats around each FP16 and each halfway point convert to the compiler's FP16") {
  bool same = true;
  for (std::uint32_t half = 0; half < 0x7C00 && same; ++half) {
    const float low = float_from_half(static_cast<std::uint16_t>(half));
    const float high = half == 0x7BFF ? 65536.f : float_from_half(static_cast<std::uint16_t>(half + 1));
    for (const float centre : {low, 0.5f * (low + high)}) {
      for (int step = -2; step <= 2 && same; ++step) {
        const std::uint32_t bits = std::bit_cast<std::uint32_t>(centre) + static_cast<std::uint32_t>(step);
        if ((bits & 0x80000000u) == 0) same = same_half(bits) && same_half(bits | 0x80000000u);
      }
    }
  }
  CHECK(same);
}
#endif

TEST_CASE("FP16 known values") {
  CHECK(half_from_float(0.f) == 0x0000);
  CHECK(half_from_float(-0.f) == 0x8000);
  CHECK(half_from_float(1.f) == 0x3C00);
  CHECK(half_from_float(kHalfMax) == 0x7BFF);
  CHECK(half_from_float(65519.f) == 0x7BFF);
  CHECK(half_from_float(65520.f) == 0x7C00);
  CHECK(half_from_float(kHalfMinNormal) == 0x0400);
  CHECK(half_from_float(kHalfMinSubnormal) == 0x0001);
  CHECK(half_from_float(0x1p-25f) == 0x0000);
  CHECK(half_from_float(0x1.000002p-25f) == 0x0001);
  CHECK(half_from_float(-std::numeric_limits<float>::infinity()) == 0xFC00);
  CHECK((half_from_float(std::numeric_limits<float>::quiet_NaN()) & 0x7FFF) > 0x7C00);
  for (std::uint32_t half = 0; half < 0x7C00; ++half) {  // round trip of all finite numbers
    const auto code = static_cast<std::uint16_t>(half);
    REQUIRE(half_from_float(float_from_half(code)) == code);
  }
}

TEST_CASE("FP16 is within 2^-11 relative in its normal range and 2^-25 below") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (int i = 0; i < 1'000'000; ++i) {
    const float normal = std::min(random_magnitude(random, -14, 16), 65504.f);
    REQUIRE(std::abs(float_from_half(half_from_float(normal)) - normal) <= normal * 0x1p-11f);
    const float small = random_magnitude(random, -40, -14);
    REQUIRE(std::abs(float_from_half(half_from_float(small)) - small) <= 0x1p-25f);
  }
}

TEST_CASE("SH steps have 17 bits and exact products and reach the largest magnitude") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  CHECK(sh_step(0.f) == 0.f);
  CHECK(sh_step(std::nextafter(kShFlush, 0.f)) == 0.f);
  CHECK(sh_step(kShFlush) == kShStepMin);
  CHECK(sh_step(kShLimit) == kShStepMax);
  CHECK(sh_step(127.f) == 1.f);
  for (int i = 0; i < 1'000'000; ++i) {
    const float max_abs = std::min(random_magnitude(random, -100, 100), kShLimit);
    CAPTURE(max_abs);
    const float step = sh_step(max_abs);
    REQUIRE((std::bit_cast<std::uint32_t>(step) & 0x7F) == 0);
    REQUIRE(127.0 * static_cast<double>(step) >= max_abs);
    REQUIRE(step <= max_abs / 127.f * (1 + 0x1p-15f));
    REQUIRE(sh_step(127.f * step) == step);
    const auto code = static_cast<std::int8_t>(static_cast<int>(random.below(255)) - 127);
    const float value = dequantize_sh(code, step);
    REQUIRE(static_cast<double>(value) == static_cast<double>(step) * code);
    REQUIRE(quantize_sh(value, step) == code);
    REQUIRE(quantize_sh(max_abs, step) == 127);
  }
}

TEST_CASE("SH error is at most half a step") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (int i = 0; i < 1'000'000; ++i) {
    const float max_abs = std::min(random_magnitude(random, -100, 100), kShLimit);
    const float step = sh_step(max_abs);
    const auto fraction = static_cast<float>(static_cast<double>(random.below(1u << 25)) * 0x1p-24 - 1);
    const float value = max_abs * fraction;
    CAPTURE(value);
    CAPTURE(step);
    const double error = std::abs(static_cast<double>(dequantize_sh(quantize_sh(value, step), step)) - value);
    REQUIRE(error <= 0.5 * static_cast<double>(step) + static_cast<double>(ulp(value)));
  }
}

TEST_CASE("SH codes round ties to even and stay in range") {
  CHECK(quantize_sh(0.5f, 1.f) == 0);
  CHECK(quantize_sh(1.5f, 1.f) == 2);
  CHECK(quantize_sh(-2.5f, 1.f) == -2);
  CHECK(quantize_sh(-3.5f, 1.f) == -4);
  CHECK(quantize_sh(1000.f, 1.f) == 127);
  CHECK(quantize_sh(-1000.f, 1.f) == -127);
  CHECK(quantize_sh(5.f, 0.f) == 0);
  CHECK(quantize_sh(kShLimit, kShStepMin) == 127);
}

TEST_CASE("the scale exponent puts the range into normal FP16 where it fits") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  CHECK(choose_scale_exponent(1.f, 1.f) == 0);
  CHECK(choose_scale_exponent(0x1p-13f, 0x1p15f) == 0);
  CHECK(choose_scale_exponent(0x1p-14f, 0x1p-14f) == 1);
  CHECK(choose_scale_exponent(1.f, 0x1p16f) == -1);
  CHECK(choose_scale_exponent(0x1p-40f, 0x1p16f) == -1);
  CHECK(choose_scale_exponent(0.f, 0.f) == kMaxScaleExponent);
  CHECK(choose_scale_exponent(0.f, 1.f) == 15);
  CHECK(choose_scale_exponent(0.f, 0x1p-140f) == kMaxScaleExponent);
  for (int i = 0; i < 200'000; ++i) {
    float low = random_magnitude(random, -86, 86), high = random_magnitude(random, -86, 86);
    if (low > high) std::swap(low, high);
    CAPTURE(low);
    CAPTURE(high);
    const int e = choose_scale_exponent(low, high);
    const auto fits = [&](int k) { return std::ldexp(low, k) >= 0x1.ffep-14f && std::ldexp(high, k) <= 0x1.002p15f; };
    REQUIRE(std::abs(e) <= 110);
    REQUIRE(quantize_scale(high, e) <= 0x7800);  // 2^15
    if (high / low < 0x1p26f) {
      REQUIRE(fits(e));
      REQUIRE((quantize_scale(low, e) >= 0x0800 && quantize_scale(low, e) < 0x7C00));
      if (e > 0) REQUIRE_FALSE((std::ldexp(low, e - 1) > 0x1.002p-13f && std::ldexp(high, e - 1) < 0x1.ffep14f));
      if (e < 0) REQUIRE_FALSE((std::ldexp(low, e + 1) > 0x1.002p-13f && std::ldexp(high, e + 1) < 0x1.ffep14f));
    } else if (high / low > 0x1p30f) {
      REQUIRE(quantize_scale(high, e) > 0x7400);
    }
    const float decoded_low = dequantize_scale(quantize_scale(low, e), e);
    const float decoded_high = dequantize_scale(quantize_scale(high, e), e);
    if (decoded_low > 0) REQUIRE(choose_scale_exponent(decoded_low, decoded_high) == e);
  }
}

TEST_CASE("every stored scale and opacity survives its logarithm or logit") {
  for (const int e : {-72, -20, 0, 20, 61, 101, 110}) {
    for (std::uint32_t half = 0; half <= 0x7800; ++half) {
      const auto code = static_cast<std::uint16_t>(half);
      const float log_scale = log_from_scale(dequantize_scale(code, e), e);
      REQUIRE(log_scale <= kMaxLogScale);
      // Codes beyond e^60 are never written; the bound replaces them.
      if (log_scale < kMaxLogScale) REQUIRE(quantize_scale(scale_from_log(log_scale), e) == code);
    }
  }
  for (std::uint32_t half = 0; half <= 0x3C00; ++half) {
    const auto code = static_cast<std::uint16_t>(half);
    REQUIRE(half_from_float(opacity_from_logit(logit_from_opacity(float_from_half(code)))) == code);
  }
  CHECK(opacity_from_logit(-30.f) < 1e-12f);
  CHECK(half_from_float(opacity_from_logit(30.f)) == 0x3C00);
}

TEST_CASE("rotations become unit quaternions with w >= 0, and storing them again changes nothing") {
  CAPTURE(kSeed);
  SplitMix random(kSeed);
  for (int i = 0; i < 200'000; ++i) {
    float q[4], norm = 0;
    for (float& x : q) x = random.dyadic(-1, 1);
    for (const float x : q) norm += x * x;
    if (norm < 1e-3f) continue;
    // A third nearly normalised, on both sides of the tolerance; a third very large or small.
    const float factor = i % 3 == 0   ? (1 + 0x1p-9f * random.dyadic(-2, 2)) / std::sqrt(norm)
                         : i % 3 == 1 ? random_magnitude(random, -50, 50)
                                      : 1.f;
    for (float& x : q) x *= factor;
    std::uint16_t codes[4], again[4];
    quantize_rotation(q, codes);
    float stored[4], unit[4];
    double squared = 0, dot = 0, length = 0;
    for (int k = 0; k < 4; ++k) {
      stored[k] = float_from_half(codes[k]);
      squared += static_cast<double>(stored[k]) * stored[k];
      length += static_cast<double>(q[k]) * q[k];
    }
    dequantize_rotation(codes, unit);
    for (int k = 0; k < 4; ++k) dot += static_cast<double>(unit[k]) * q[k];
    REQUIRE((codes[0] & 0x8000) == 0);
    REQUIRE(std::abs(squared - 1) <= kUnitNormTolerance);
    REQUIRE(std::abs(dot) / std::sqrt(length) > 1 - 1e-6);
    quantize_rotation(stored, again);
    REQUIRE(std::equal(codes, codes + 4, again));
  }
}
