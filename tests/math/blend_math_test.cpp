// blend_math_test.cpp - depth keys, approximate exponentials, folded exponents and compositing.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/blend.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "random_views.hpp"
#include "rgs/math/coverage.hpp"

using namespace rgs::math;
using namespace rgs::test;

TEST_CASE("tile bits are the ceiling of log2") {
  CHECK(tile_bits(0) == 0);
  CHECK(tile_bits(1) == 0);
  CHECK(tile_bits(2) == 1);
  CHECK(tile_bits(8160) == 13);
  CHECK(tile_bits(8192) == 13);
  CHECK(tile_bits(8193) == 14);
  CHECK(tile_bits(0xFFFFFFFFU) == 32);
}

TEST_CASE("quantised depth is monotone, spans its bins and clamps") {
  for (const auto mapping : {DepthMapping::linear, DepthMapping::logarithmic}) {
    for (const int bits : {1, 15, 19, 24, 25, 28, 32}) {
      const auto q = make_depth_quantizer(mapping, bits, 0.2F, 100.0F);
      const double bins = std::exp2(bits) - 1;
      CHECK(quantize_depth(q, 0.01F) == 0);
      CHECK(quantize_depth(q, 0.2F) <= bins * 1e-6);
      CHECK(quantize_depth(q, 1e9F) <= bins);
      CHECK(quantize_depth(q, 1e9F) >= bins * (1 - 1e-6));
      std::uint32_t last = 0;
      bool monotone = true;
      for (float z = 0.1F; z < 120; z *= 1.0003F) {
        const auto key = quantize_depth(q, z);
        monotone = monotone && key >= last;
        last = key;
        if (z < 0.2F || z > 100) continue;
        const double t = mapping == DepthMapping::logarithmic ? std::log(z / 0.2) / std::log(500.0) : (z - 0.2) / 99.8;
        CHECK(std::abs(key - t * bins) < 1 + 1e-5 * bins);
      }
      CHECK(monotone);
    }
  }
}

TEST_CASE("positive depths sort as their bits") {
  for (float z = 1e-3F; z < 1e6F; z *= 1.37F) CHECK(depth_bits(z) < depth_bits(std::nextafter(z, 1e9F)));
}

TEST_CASE("bit-built exponentials keep their error bound over [-ln 255, 0]") {
  const auto errors = [](float sigma) {
    double low = 1, high = -1, sum = 0;
    const int n = 100000;
    for (int i = 0; i <= n; ++i) {
      const double p = -std::log(255.0) * i / n;
      const double e = exp2_bits(static_cast<float>(p * 1.4426950408889634), sigma) / std::exp(p) - 1;
      low = std::min(low, e), high = std::max(high, e), sum += e;
    }
    return std::array<double, 3>{low, high, sum / n};
  };
  const auto paper = errors(kSigmaPaper);
  CHECK(paper[0] == doctest::Approx(-0.0312).epsilon(0.005));
  CHECK(paper[1] == doctest::Approx(0.0284).epsilon(0.005));
  CHECK(paper[2] == doctest::Approx(0.0083).epsilon(0.02));
  const auto zero_mean = errors(kSigmaZeroMean);
  CHECK(zero_mean[0] == doctest::Approx(-0.0393).epsilon(0.005));
  CHECK(zero_mean[1] == doctest::Approx(0.0198).epsilon(0.005));
  CHECK(std::abs(zero_mean[2]) < 1e-4);
}

TEST_CASE("the exponential by a shift equals the bit-built one to 2^-16 over [-ln 255, 0]") {
  for (const float sigma : {kSigmaPaper, kSigmaZeroMean}) {
    double worst = 0, worst_at = 0;
    const int n = 800000;
    for (int i = 0; i <= n; ++i) {
      const auto p = static_cast<float>(-std::log2(255.0) * i / n);
      const double expected = static_cast<double>(exp2_bits(p, sigma));
      const double e = std::abs(-static_cast<double>(negative_exp2(p + exp2_bias(sigma))) / expected - 1);
      if (e > worst) worst = e, worst_at = static_cast<double>(p);
    }
    CAPTURE(worst_at);
    // Half from rounding the biased exponent, half from the seven bits that the shift drops.
    CHECK(worst <= 0x1p-16 * 1.001);
    CHECK(worst > 0x1p-18);
  }
}

TEST_CASE("the exponential by a shift keeps its sign and the clamp just below, at and above 0") {
  for (const float sigma : {kSigmaPaper, kSigmaZeroMean}) {
    const float bias = exp2_bias(sigma);
    const auto alpha = [bias](float p) { return -negative_exp2(min(p + bias, kBiasedAlphaMax)); };
    float last = 0;
    for (float p = -0.3F; p < 1.5F; p += 1e-4F) {
      const float a = alpha(p);
      REQUIRE(a >= last);
      REQUIRE(a <= kAlphaMax + 0x1p-16F);
      REQUIRE(std::abs(a - min(kAlphaMax, exp2_bits(min(p, 1.0F), sigma))) <= 0x1p-16F);
      last = a;
    }
    CHECK(alpha(1e-6F) == doctest::Approx(static_cast<double>(exp2_bits(1e-6F, sigma))).epsilon(2e-5));
    CHECK(alpha(100) == last);
    // As many opaque Gaussians end a pixel as with kAlphaMax itself: two.
    CHECK((1 - kAlphaMax) * (1 - kAlphaMax) < kTransmittanceMin);
    CHECK((1 - last) * (1 - last) < kTransmittanceMin);
    // The ends of the range: 2^-126 still has its exponent, and values below the cutoff are never requested.
    CHECK(alpha(-120.5F) > 0);
    CHECK(alpha(-120.5F) < 0x1p-119F);
  }
}

TEST_CASE("opacities stay in {0} and [1/255, 0.99] whatever the exponent") {
  for (const float opacity : {0.0F, 0.003F, 1.0F / 255, 0.5F, 0.99F, 1.0F}) {
    const float cutoff = power_cutoff(opacity);
    for (float p = -100; p < 1; p += 0.013F) {
      const float a = alpha_direct<Exp::exact>(p, opacity, cutoff), b = alpha_direct<Exp::paper>(p, opacity, cutoff);
      CHECK((a == 0 || (a >= kAlphaMin && a <= kAlphaMax)));
      CHECK((b == 0 || (b >= kAlphaMin * 0.96F && b <= kAlphaMax)));
      CHECK((p <= 0 || a == 0));
    }
  }
  for (float p = -200; p < 3; p += 0.013F) {
    const float a = alpha_folded<Exp::exact>(p), b = alpha_folded<Exp::zero_mean>(p);
    CHECK((a == 0 || (a >= kAlphaMin * 0.99999F && a <= kAlphaMax)));
    CHECK((b == 0 || (b >= kAlphaMin * 0.96F && b <= kAlphaMax)));
    CHECK((a == 0) == (b == 0));
  }
  CHECK(alpha_folded<Exp::paper>(NAN) == 0);
  CHECK(alpha_folded<Exp::exact>(-INFINITY) == 0);
}

TEST_CASE("the approximations count the same pairs as the exact exponential") {
  for (const float opacity : {0.01F, 0.3F, 1.0F}) {
    const float cutoff = power_cutoff(opacity);
    for (float p = -6; p <= 0; p += 0.00037F) {
      if (std::abs(p - cutoff) < 1e-5F) continue;
      CHECK((alpha_direct<Exp::exact>(p, opacity, cutoff) == 0) == (alpha_direct<Exp::paper>(p, opacity, cutoff) == 0));
    }
  }
}

TEST_CASE("the folded exponent equals log2(opacity) + log2(e) power at 4K, near and far from the mean") {
  Random random(11);
  double worst = 0;
  for (int i = 0; i < 4000; ++i) {
    const bool far = i % 2 == 1;
    const double major = far ? random.uniform(400, 1500) : random.log_uniform(0.6, 40);
    const double minor = far ? major * random.uniform(0.3, 1) : random.log_uniform(0.6, major);
    const double angle = random.uniform(0, 3.2), c = std::cos(angle), s = std::sin(angle);
    const double xx = major * major * c * c + minor * minor * s * s, yy = major * major * s * s + minor * minor * c * c;
    const double xy = (major * major - minor * minor) * c * s, det = xx * yy - xy * xy;
    const Conic<double> exact{yy / det, -xy / det, xx / det};
    const Conic<float> conic{static_cast<float>(exact.a), static_cast<float>(exact.b), static_cast<float>(exact.c)};
    const double reach = far ? 2000 : 3 * major;
    const PixelPoint<float> mean{static_cast<float>(8 + reach * random.uniform(-1, 1)),
                                 static_cast<float>(8 + reach * random.uniform(-1, 1))};
    const auto folded = fold(conic, mean, std::log2(0.7F));
    for (int y = 0; y < kTileSize; y += 3) {
      for (int x = 0; x < kTileSize; x += 3) {
        const double expected = std::log2(0.7) + 1.4426950408889634 * power(exact, static_cast<double>(mean.u) - x,
                                                                            static_cast<double>(mean.v) - y);
        if (expected < -8) continue;
        const float fx = static_cast<float>(x), fy = static_cast<float>(y);
        const float value = folded_exponent(folded, fx, fy);
        worst = std::max(worst, std::abs(value - expected));
        CHECK(std::abs(folded_exponent_below(folded, value, fx, fy) - folded_exponent(folded, fx, fy + 1)) < 1e-3F);
      }
    }
  }
  // 5e-4 in the exponent is 0.035% of an opacity. Absolute coordinates would be off by whole units here.
  CHECK(worst < 5e-4);
  MESSAGE("largest error of the folded exponent: ", worst);
}

TEST_CASE("compositing: weights, early stop without blending, background, expected depth") {
  Pixel<float> pixel;
  REQUIRE(blend(pixel, 0.5F, Vec3<float>{1, 0, 0}, 2.0F));
  REQUIRE(blend(pixel, 0.5F, Vec3<float>{0, 1, 0}, 4.0F));
  CHECK(pixel.r == 0.5F);
  CHECK(pixel.g == 0.25F);
  CHECK(pixel.transmittance == 0.25F);
  CHECK(expected_depth(pixel) == doctest::Approx((0.5 * 2 + 0.25 * 4) / 0.75));
  const auto c = resolve(pixel, Vec3<float>{0, 0, 1});
  CHECK(c.z == 0.25F);
  CHECK(expected_depth(Pixel<float>{}) == 0);
  int n = 2;
  while (blend(pixel, kAlphaMax, Vec3<float>{0, 0, 1}, 1.0F)) ++n;
  CHECK(n == 3);  // 0.25 -> 0.0025 -> 0.000025 is refused
  CHECK(pixel.transmittance >= kTransmittanceMin);
  CHECK(pixel.b == doctest::Approx(0.25 * 0.99));
}
