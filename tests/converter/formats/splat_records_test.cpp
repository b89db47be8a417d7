// splat_records_test.cpp - .splat: a record by hand, round trips, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <cstring>
#include <limits>
#include <span>
#include <string>

#include "interchange_samples.hpp"

using namespace rgs;
using namespace rgs::test;

TEST_CASE(".splat: a record by hand") {
  std::vector<std::byte> bytes(32);
  const float numbers[6] = {1, -2, 3.5F, 1, 2, 0};
  std::memcpy(bytes.data(), numbers, sizeof numbers);
  const std::uint8_t codes[8] = {0, 255, 51, 102, 230, 128, 80, 64};
  std::memcpy(&bytes[24], codes, sizeof codes);
  const auto file = read_splats(bytes);
  REQUIRE(file);
  CHECK(file->format == SplatFormat::splat);
  const Splat s = file->cloud.view().splat(0);
  CHECK(s.mean[2] == 3.5F);
  CHECK(s.log_scale[0] == 0);
  CHECK(s.log_scale[1] == doctest::Approx(std::log(2)));
  CHECK(s.log_scale[2] < -18);  // a scale of zero
  CHECK(s.sh[0] == doctest::Approx(-0.5 / 0.28209479));
  CHECK(s.sh[1] == doctest::Approx(0.5 / 0.28209479));
  CHECK(s.sh[2] == doctest::Approx(-0.3 / 0.28209479));
  CHECK(opacity_from_logit(s.opacity_logit) == doctest::Approx(0.4));
  CHECK(s.rotation[0] == 102.F / 128);
  CHECK(s.rotation[1] == 0);
  CHECK(s.rotation[2] == -48.F / 128);
  CHECK(s.rotation[3] == -0.5F);
}

TEST_CASE(".splat round trip: exact means, scales to the last place, bytes for the rest, no harmonics") {
  for (const std::uint64_t n : {1U, 2U, 1000U}) {
    CAPTURE(n);
    SplatCloud cloud = ordinary_cloud(n, 2, n);
    const auto bytes = encode_splats(cloud.view(), SplatFormat::splat);
    REQUIRE(bytes);
    CHECK(bytes->size() == 32 * n);
    const auto file = read_splats(*bytes);
    REQUIRE(file);
    CHECK(file->cloud.sh_degree == 0);
    for (std::uint64_t i = 0; i < n; ++i) {
      const SplatError e = compare(file->cloud.view().splat(i), cloud.view().splat(i), 0);
      for (int k = 0; k < 3; ++k) {
        CHECK(e.mean[k] == 0);
        CHECK(e.log_scale[k] <= 1e-6);
      }
      CHECK(e.opacity <= 0.5 / 255 * 1.001);
      CHECK(e.sh[0] <= 0.5 / 255 / 0.28209479 * 1.001);
      CHECK(e.rotation <=
            2.0 / 128);  // normalising combines four errors of half a step; 1 itself is off by a whole step
    }
  }
}

TEST_CASE(".splat files of nonsense or of a size that is no multiple of 32 are refused") {
  const std::vector<std::byte> bytes = encode_splats(ordinary_cloud(2, 0, 1).view(), SplatFormat::splat).value();
  for (std::size_t size = 0; size < bytes.size(); ++size) {
    CAPTURE(size);
    const auto file = read_exact(std::span(bytes).first(size));
    if (size == 32) {
      CHECK(file);
    } else {
      check_refusal(file, size);
    }
  }
  for (const float value : {std::numeric_limits<float>::quiet_NaN(), -1.F, std::numeric_limits<float>::infinity()}) {
    std::vector<std::byte> damaged = bytes;
    std::memcpy(&damaged[32 + 12], &value, 4);
    check_refusal(read_splats(damaged), damaged.size());
  }
  check_refusal(read_splats(Bytes(4096)), 4096);  // zeros
}

TEST_CASE(".splat: a text of as many bytes as records have is none") {
  std::string text;
  for (int i = 0; i < 64; ++i) text += "{\"schema\":\"state/1\",\"input_p\":1}";
  REQUIRE(text.size() % 32 == 0);
  CHECK(detect_format(std::as_bytes(std::span(text))) == SplatFormat::unknown);
}
