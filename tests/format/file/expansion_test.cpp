// expansion_test.cpp - writers stay within the expansion that readers allow by default, however similar the Gaussians;
// and callers' limits hold.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "archive_bounds.hpp"
#include "golden_scenes.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// n copies of one Gaussian, or a grid of them.
SplatCloud alike(std::uint64_t n, int degree, bool colour, bool grid) {
  SplatCloud cloud;
  cloud.resize(n, degree);
  Splat s = golden_cloud(1, degree, 3).view().splat(0);
  if (!colour) std::fill_n(s.sh, 48, 0.f);
  for (std::uint64_t i = 0; i < n; ++i) {
    if (grid) s.mean[0] = static_cast<float>(i / 1000), s.mean[1] = static_cast<float>(i % 1000);
    cloud.set(i, s);
  }
  return cloud;
}

std::uint64_t coded_bytes(const FileView& view) {
  std::uint64_t sum = 0;
  for (const SectionEntry& s : view.sections()) sum += s.codec == 0 ? 0 : s.decoded_bytes;
  return sum;
}

}  // namespace

TEST_CASE("the reader's defaults accept files of equal Gaussians") {
  for (const int degree : {0, 1, 2, 3}) {
    const SplatCloud cloud = alike(200'000, degree, degree % 2 == 0, degree == 1);
    for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
      for (const std::uint32_t chunk_size : {32u, 256u, 16384u}) {
        if (degree != 0 && chunk_size != 256) continue;
        CAPTURE(degree);
        CAPTURE(static_cast<int>(profile));
        CAPTURE(chunk_size);
        EncodeOptions options;
        options.profile = profile;
        options.chunk_size = chunk_size;
        options.chunk_step_sets = degree != 2;
        options.level = degree == 3 ? 3 : 1;
        const auto bytes = encode(cloud.view(), options);
        REQUIRE(bytes);
        const auto view = FileView::open(*bytes);
        REQUIRE(view);
        CHECK(coded_bytes(*view) <= 1024 * bytes->size());
        CHECK(view->header().n_gaussians == 200'000);
        REQUIRE(load_direct(*view));
        std::vector<ActivatedSplat> ends(1);
        REQUIRE(view->read(199'999, std::span(ends)));
        if (profile == Profile::archive) {  // as far as a pixel's blur shows it
          CHECK(blurred_errors(StatedBounds(*bytes), 0, cloud.view().splat(0), ends[0]).covariance <= 0.2);
        } else {
          CHECK(std::abs(ends[0].scale[0] - scale_from_log(cloud.log_scale[0])) <= 0.2f * ends[0].scale[0]);
        }
      }
    }
  }
}

TEST_CASE("small files stay small: the bound costs a thousandth of the decoded size") {
  EncodeOptions options;
  options.profile = Profile::packed;
  const auto bytes = encode(alike(200'000, 3, true, false).view(), options);
  REQUIRE(bytes);
  CHECK(bytes->size() < 200'000 * 76 / 400);
}

TEST_CASE("an archive whose chunks allow no frame small enough says what to do") {
  EncodeOptions options;
  options.profile = Profile::archive;
  options.chunk_size = 32768;
  const auto bytes = encode(alike(400'000, 3, true, false).view(), options);
  if (bytes) {
    CHECK(FileView::open(*bytes));
  } else {
    CHECK(bytes.error().code == Errc::limit_exceeded);
    CHECK(std::string(bytes.error().what).find("packed") != std::string::npos);
  }
}

TEST_CASE("limits on decoded size: a ratio, and bytes regardless of the ratio") {
  CHECK(DecodeLimits().decoded_bytes(0) == 1u << 20);
  CHECK(DecodeLimits().decoded_bytes(1000) == 1'032'000 + (1u << 20));
  CHECK(DecodeLimits().decoded_bytes(~std::uint64_t{0}) == std::uint64_t{1} << 40);
  CHECK(DecodeLimits{.max_expansion = ~std::uint64_t{0}, .max_decoded_bytes = 5}.decoded_bytes(1) == 5);
  EncodeOptions options;
  options.profile = Profile::packed;
  const auto bytes = encode(alike(20'000, 0, true, false).view(), options);
  REQUIRE(bytes);
  const auto opened = FileView::open(*bytes);
  REQUIRE(opened);
  const std::uint64_t decoded = coded_bytes(*opened);
  CHECK(FileView::open(*bytes, {.max_decoded_bytes = decoded}));
  const auto refused = FileView::open(*bytes, {.max_decoded_bytes = decoded - 1});
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
}
