// bench_quality_test.cpp - distances from the baseline and from photographs, and the photographs' paths.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "bench_quality.hpp"

namespace {

using rgs::Image;

Image flat(float value) {
  Image image = Image::make(16, 16, 3);
  for (float& v : image.pixels) v = value;
  return image;
}

}  // namespace

TEST_CASE("quality is the mean and the worst over the pictures") {
  const std::vector<Image> baseline{flat(0.5F), flat(0.5F)}, pictures{flat(0.6F), flat(0.51F)};
  const auto q = rgs::bench::compare(baseline, pictures, {});
  REQUIRE(q);
  CHECK(q->psnr == doctest::Approx(30).epsilon(1e-4));  // 20 and 40 dB
  CHECK(q->worst_psnr == doctest::Approx(20).epsilon(1e-4));
  CHECK(q->largest == doctest::Approx(0.1));
  CHECK(q->ssim < 1);
  CHECK_FALSE(q->photo_psnr);
}

TEST_CASE("equal pictures have infinite PSNR") {
  const std::vector<Image> pictures{flat(0.25F)};
  const auto q = rgs::bench::compare(pictures, pictures, {});
  REQUIRE(q);
  CHECK(q->psnr == std::numeric_limits<double>::infinity());
  CHECK(q->ssim == 1);
  CHECK(q->largest == 0);
}

TEST_CASE("loss against photographs is of displayed colours") {
  // Baseline and picture differ beyond white, which neither a display nor a photograph shows.
  const std::vector<Image> baseline{flat(1.2F)}, pictures{flat(1.7F)}, photos{flat(0.9F)};
  const auto q = rgs::bench::compare(baseline, pictures, photos);
  REQUIRE(q);
  CHECK(q->largest == doctest::Approx(0.5));
  REQUIRE(q->photo_psnr);
  CHECK(*q->photo_psnr == doctest::Approx(20).epsilon(1e-4));
  CHECK(*q->photo_loss == doctest::Approx(0));
}

TEST_CASE("a picture farther from the photograph than the baseline has a loss above zero") {
  const std::vector<Image> baseline{flat(0.5F)}, pictures{flat(0.6F)}, photos{flat(0.4F)};
  const auto q = rgs::bench::compare(baseline, pictures, photos);
  REQUIRE(q);
  CHECK(*q->photo_loss == doctest::Approx(20 * std::log10(2)).epsilon(1e-4));
}

TEST_CASE("pictures that cannot be compared are refused") {
  const std::vector<Image> baseline{flat(0.5F)}, photos{Image::make(8, 8, 3)};
  CHECK_FALSE(rgs::bench::compare(baseline, baseline, photos));
  const std::vector<Image> broken{flat(std::numeric_limits<float>::quiet_NaN())};
  CHECK_FALSE(rgs::bench::compare(baseline, broken, {}));
}

TEST_CASE("a photograph is named like its camera") {
  rgs::Camera camera;
  camera.name = "images/P1180141.JPG";
  CHECK(rgs::bench::photo_path("photos", camera) == "photos/P1180141.ppm");
}
