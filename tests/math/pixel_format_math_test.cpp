// pixel_format_math_test.cpp - packed pixels against their definitions in FP64.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "random_views.hpp"
#include "rgs/math/pixel_format.hpp"

using namespace rgs;
using namespace rgs::math;

TEST_CASE("unorm8 is round(255 clamp(v, 0, 1)), ties to even, for any float") {
  const auto expected = [](float v) {
    const double scaled = 255 * std::fmin(std::fmax(static_cast<double>(v), 0.0), 1.0);  // exact: 24 and 8 bits
    return static_cast<std::uint32_t>(std::nearbyint(scaled));
  };
  rgs::test::Random random(901);
  for (int k = 0; k < 300000; ++k) {
    const float v = static_cast<float>(random.uniform(-0.1, 1.1));
    REQUIRE_MESSAGE(unorm8(v) == expected(v), v);
  }
  // Both neighbours of every midpoint between two codes, and the FP32 number nearest to it.
  for (int code = 0; code < 255; ++code) {
    const float between = (static_cast<float>(code) + 0.5F) / 255;
    for (const float v : {std::nextafter(between, 0.0F), between, std::nextafter(between, 1.0F)}) {
      CHECK(unorm8(v) == expected(v));
    }
    CHECK(unorm8(static_cast<float>(code) / 255) == static_cast<std::uint32_t>(code));
  }
  CHECK(unorm8(0.5F) == 128);  // 127.5: a tie, to the even one
  CHECK(unorm8(1) == 255);
  CHECK(unorm8(-0.0F) == 0);
  CHECK(unorm8(std::numeric_limits<float>::infinity()) == 255);
  CHECK(unorm8(-std::numeric_limits<float>::infinity()) == 0);
  CHECK(unorm8(std::numeric_limits<float>::denorm_min()) == 0);
  CHECK(unorm8(std::numeric_limits<float>::quiet_NaN()) == 0);
}

TEST_CASE("packed pixels lie in memory as red, green, blue, alpha") {
  const Vec3<float> color{0.2F, 1.5F, -1};
  CHECK(pack_rgba8(color, 0.5F) == 0x8000FF33u);
  CHECK(pack_rgba16f(color, 0.5F) == 0x3800'BC00'3E00'3266u);  // 0.5, -1, 1.5, 0.2 to 11 bits
  CHECK(pixel_bytes(PixelFormat::rgba8) == 4);
  CHECK(pixel_bytes(PixelFormat::rgba16f) == 8);
}
