// image_metrics_test.cpp - edge cases of the measures; image_metrics_test.py checks values independently.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/image_metrics.hpp"

#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "random_views.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

Image noise(unsigned seed, int width, int height, int channels) {
  Random random(seed);
  Image image = Image::make(width, height, channels);
  for (float& v : image.pixels) v = static_cast<float>(random.uniform(-0.1, 1.2));
  return image;
}

}  // namespace

TEST_CASE("equal pictures have infinite PSNR without NaN, whatever their content") {
  for (const Image& image : {noise(1, 37, 23, 3), Image::make(64, 5, 1), noise(2, 1, 1, 3)}) {
    const auto d = difference(image, image);
    REQUIRE(d);
    CHECK(d->mse == 0);
    CHECK(d->psnr == std::numeric_limits<double>::infinity());
    CHECK(d->largest == 0);
    CHECK(ssim(image, image).value() == 1.0);
  }
  Image bright = noise(3, 20, 20, 3);
  for (float& v : bright.pixels) v *= 1e12F;  // variances vanish in rounding
  CHECK(ssim(bright, bright).value() == 1.0);
}

TEST_CASE("a known difference has its squared error, PSNR and pixel") {
  Image a = Image::make(5, 4, 3), b = a;
  b.at(3, 2, 1) = 0.5F;
  b.at(4, 3, 2) = -0.5F;  // equal, but later
  const auto d = difference(a, b);
  REQUIRE(d);
  CHECK(d->mse == doctest::Approx(0.5 / 60));
  CHECK(d->psnr == doctest::Approx(10 * std::log10(120)));
  CHECK(d->largest == 0.5F);
  CHECK(d->largest_index == (2 * 5 + 3) * 3 + 1);
}

TEST_CASE("SSIM of a single pixel follows from the window's centre weight") {
  Image a = Image::make(1, 1, 1), b = a;
  a.pixels[0] = 0.4F, b.pixels[0] = 0.7F;
  double sum = 0;
  for (int i = -5; i <= 5; ++i) sum += std::exp(-i * i / 4.5);
  const double w = 1 / (sum * sum), x = 0.4F, y = 0.7F, c1 = 1e-4, c2 = 9e-4;
  const double mx = w * x, my = w * y, vx = w * x * x - mx * mx, vy = w * y * y - my * my, cov = w * x * y - mx * my;
  const double expected = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2));
  CHECK(ssim(a, b).value() == doctest::Approx(expected).epsilon(1e-12));
}

TEST_CASE("SSIM is symmetric, and falls with noise") {
  const Image a = noise(4, 50, 40, 3);
  Image b = a, c = a;
  Random random(5);
  for (std::size_t i = 0; i < a.pixels.size(); ++i) {
    const double e = random.uniform(-1, 1);
    b.pixels[i] += static_cast<float>(0.05 * e), c.pixels[i] += static_cast<float>(0.2 * e);
  }
  CHECK(ssim(a, b).value() == ssim(b, a).value());
  CHECK(ssim(a, b).value() < 1);
  CHECK(ssim(a, c).value() < ssim(a, b).value());
}

TEST_CASE("the number of threads changes no bit of a comparison") {
  const Image a = noise(6, 133, 257, 3), b = noise(7, 133, 257, 3);
  const auto d = difference(a, b);
  const auto s = ssim(a, b);
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  CHECK(difference(a, b)->mse == d->mse);
  CHECK(difference(a, b)->largest_index == d->largest_index);
  CHECK(ssim(a, b).value() == s.value());
}

TEST_CASE("pictures that cannot be compared are refused") {
  const Image a = Image::make(4, 3, 3);
  for (const Image& b : {Image::make(3, 4, 3), Image::make(4, 3, 1), Image::make(4, 4, 3), Image{4, 3, 3, {}}}) {
    CHECK(difference(a, b).error().code == Errc::bad_argument);
    CHECK(ssim(a, b).error().code == Errc::bad_argument);
  }
  CHECK(difference(Image(), Image()).error().code == Errc::bad_argument);
  CHECK(ssim(Image(), Image()).error().code == Errc::bad_argument);
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    Image b = a;
    b.pixels[17] = bad;
    for (const Error& error :
         {difference(a, b).error(), difference(b, b).error(), ssim(a, b).error(), ssim(b, b).error()}) {
      CHECK(error.code == Errc::bad_value);
      CHECK(error.offset == 17);
    }
  }
}

TEST_CASE("FLIP of equal pictures is 0, and of flat black and white what the colours' distance makes it") {
  for (const Image& image : {noise(1, 37, 23, 3), noise(2, 1, 1, 3)}) CHECK(flip(image, image).value() == 0);
  const Image black = Image::make(30, 20, 3);
  Image white = black, green = black, blue = black;
  std::fill(white.pixels.begin(), white.pixels.end(), 3.0F);  // shown as 1
  for (std::size_t i = 0; i < black.pixels.size(); i += 3) green.pixels[i + 1] = 1, blue.pixels[i + 2] = 1;
  // HyAB 100 of the largest 203.3; 100^0.7 lies (25.12 - 16.50) / (41.25 - 16.50) above the knee at 0.95.
  CHECK(flip(black, white).value() == doctest::Approx(0.9674).epsilon(2e-4));
  CHECK(flip(green, blue).value() == doctest::Approx(1).epsilon(1e-6));
}

TEST_CASE("FLIP is that of its authors' program") {
  Image a = Image::make(40, 30, 3), b = a;
  for (int y = 0; y < 30; ++y) {
    for (int x = 20; x < 40; ++x) {
      a.at(x, y, 0) = 1, a.at(x, y, 1) = 0.5F, a.at(x, y, 2) = 0.25F;
      if (y >= 10 && x >= 22) b.at(x, y, 0) = 0.25F, b.at(x, y, 1) = 0.75F, b.at(x, y, 2) = 1;
    }
  }
  // compute_ldrflip() of NVlabs/flip at commit 313517b, which computes in FP32.
  CHECK(flip(a, b).value() == doctest::Approx(0.5503626).epsilon(1e-6));
  CHECK(flip(a, b, 30).value() == doctest::Approx(0.5153353).epsilon(1e-6));
}

TEST_CASE("FLIP is symmetric, has its map's mean, falls with resolution, and has the same bits for any threads") {
  const Image a = noise(31, 61, 43, 3), b = noise(32, 61, 43, 3);
  Image map;
  const double found = flip(a, b, 67.02, &map).value();
  CHECK(flip(b, a).value() == found);
  REQUIRE(map.pixels.size() == 61U * 43);
  CHECK(map.channels == 1);
  double sum = 0;
  for (const float v : map.pixels) sum += static_cast<double>(v);
  CHECK(sum / (61 * 43) == doctest::Approx(found).epsilon(1e-6));
  CHECK(flip(a, b, 20).value() > flip(a, b, 120).value());  // noise too fine to be seen
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  CHECK(flip(a, b).value() == found);
}

TEST_CASE("FLIP refuses what it cannot compare") {
  const Image a = noise(3, 4, 4, 3), grey = noise(4, 4, 4, 1);
  Image bad = a;
  bad.pixels[7] = std::numeric_limits<float>::quiet_NaN();
  CHECK(flip(a, noise(3, 4, 5, 3)).error().code == Errc::bad_argument);
  CHECK(flip(grey, grey).error().code == Errc::bad_argument);
  CHECK(flip(a, a, 0).error().code == Errc::bad_argument);
  CHECK(flip(a, bad).error().code == Errc::bad_value);
  CHECK(flip(a, bad).error().offset == 7);
}

namespace {

// Patterns, and these with less contrast in one part and one channel flat in another.
std::array<Image, 2> patterns(int width, int height) {
  Image a = Image::make(width, height, 3), b = a;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int values[3] = {x * y % 64 * 4, (x * x + y) % 128 * 2, (x + 3 * y) % 256};
      for (int c = 0; c < 3; ++c) {
        const float v = a.at(x, y, c) = static_cast<float>(values[c]) / 256;
        b.at(x, y, c) = c == 1 && x < 50 ? 0.5F : x >= 60 && y >= 40 && y < 130 ? 0.75F * v + 0.125F : v;
      }
    }
  }
  return {a, b};
}

}  // namespace

TEST_CASE("MS-SSIM and GMSD are what numpy makes of their definitions, also with fewer scales") {
  const auto [a, b] = patterns(201, 170);
  CHECK(ms_ssim(a, b).value() == doctest::Approx(0.934701048788645).epsilon(1e-7));
  CHECK(gmsd(a, b).value() == doctest::Approx(0.19679128459982476).epsilon(1e-7));
  const auto [c, d] = patterns(90, 50);
  CHECK(ms_ssim(c, d).value() == doctest::Approx(0.8333284032093072).epsilon(1e-7));
  CHECK(gmsd(c, d).value() == doctest::Approx(0.2609775903854274).epsilon(1e-7));
}

TEST_CASE("MS-SSIM of equal pictures is 1 and GMSD 0; both are symmetric and have the same bits for any threads") {
  for (const Image& image : {noise(1, 37, 23, 3), noise(2, 11, 11, 3), noise(3, 181, 177, 1)}) {
    CHECK(ms_ssim(image, image).value() == 1);
    CHECK(gmsd(image, image).value() == 0);
  }
  CHECK(gmsd(noise(4, 1, 1, 3), noise(5, 1, 1, 3)).value() == 0);  // one pixel deviates from no mean
  Image dark = noise(6, 30, 30, 1);
  for (float& v : dark.pixels) v = 1 - v;
  CHECK(ms_ssim(dark, noise(6, 30, 30, 1)).value() == 0);  // the negative of a picture: no NaN
  Image large = noise(9, 40, 40, 3);
  for (float& v : large.pixels) v = std::numeric_limits<float>::max() * (0.7F + 0.2F * v);
  CHECK(ms_ssim(large, large).value() == 1);
  CHECK(gmsd(large, large).value() == 0);
  const Image a = noise(7, 133, 257, 3), b = noise(8, 133, 257, 3);
  const double m = ms_ssim(a, b).value(), g = gmsd(a, b).value();
  CHECK(ms_ssim(b, a).value() == m);
  CHECK(gmsd(b, a).value() == g);
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  CHECK(ms_ssim(a, b).value() == m);
  CHECK(gmsd(a, b).value() == g);
}

TEST_CASE("maps of MS-SSIM and GMSD show where their values come from") {
  const Image one = noise(1, 20, 19, 1), two = noise(2, 20, 19, 1);  // one scale
  Image map;
  const double m = ms_ssim(one, two, &map).value();
  CHECK(m == ms_ssim(one, two).value());
  REQUIRE(map.pixels.size() == 20 * 19);
  CHECK(map.at(4, 9, 0) == 0);  // its window reaches beyond the edge
  double sum = 0;
  for (int y = 5; y < 14; ++y)
    for (int x = 5; x < 15; ++x) sum += static_cast<double>(map.at(x, y, 0));
  CHECK(1 - sum / 90 <= 1);
  CHECK(1 - sum / 90 >= m - 1e-6);  // negative values count as 0 pixel by pixel
  const auto [a, b] = patterns(201, 170);
  REQUIRE(ms_ssim(a, b, &map));
  CHECK(map.width == 201);
  CHECK(map.at(20, 60, 0) > 0.2);     // a channel is flat
  CHECK(map.at(150, 160, 0) < 0.01);  // equal far around
  CHECK(map.at(100, 90, 0) > map.at(150, 160, 0));
  const double g = gmsd(a, b, &map).value();
  REQUIRE(map.width == 101);
  REQUIRE(map.height == 85);
  double mean = 0, squares = 0;
  for (const float v : map.pixels) mean += static_cast<double>(v) / (101 * 85);
  for (const float v : map.pixels) squares += (static_cast<double>(v) - mean) * (static_cast<double>(v) - mean);
  CHECK(std::sqrt(squares / (101 * 85)) == doctest::Approx(g).epsilon(1e-5));
  CHECK(ms_ssim(a, a, &map).value() == 1);
  CHECK(std::all_of(map.pixels.begin(), map.pixels.end(), [](float v) { return v == 0; }));
}

TEST_CASE("MS-SSIM and GMSD refuse what they cannot compare") {
  const Image a = noise(3, 12, 12, 3), two = noise(4, 12, 12, 2), narrow = noise(5, 10, 40, 3);
  Image bad = a;
  bad.pixels[7] = std::numeric_limits<float>::infinity();
  for (const auto& measure : {ms_ssim, gmsd}) {
    CHECK(measure(a, two, nullptr).error().code == Errc::bad_argument);
    CHECK(measure(a, bad, nullptr).error().code == Errc::bad_value);
    CHECK(measure(a, bad, nullptr).error().offset == 7);
  }
  CHECK(ms_ssim(narrow, narrow).error().code == Errc::bad_argument);
  CHECK(ms_ssim(two, two).value() == 1);
  CHECK(gmsd(two, two).error().code == Errc::bad_argument);
}
