// packed_test.cpp - Profile::packed decodes to the bytes of Profile::direct, as a whole and by chunk.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <random>

#include "edit_file.hpp"
#include "golden_scenes.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

struct Pair {
  Bytes direct, packed;
};

Pair encode_both(const SplatCloud& cloud, EncodeOptions options) {
  options.profile = Profile::direct;
  auto direct = encode(cloud.view(), options);
  options.profile = Profile::packed;
  auto packed = encode(cloud.view(), options);
  REQUIRE(direct);
  REQUIRE(packed);
  return {std::move(*direct), std::move(*packed)};
}

void check_same(std::span<const std::byte> a, std::span<const std::byte> b) {
  REQUIRE(a.size() == b.size());
  CHECK(std::ranges::equal(a, b));
}

// Everything that decoding gives, from both files.
void check_equal(const Pair& pair, const LoadOptions& options = {}) {
  const auto a = open(pair.direct), b = open(pair.packed);
  REQUIRE(a);
  REQUIRE(b);
  CHECK_FALSE(a->coded());
  CHECK(b->coded());
  CHECK(a->header().version_minor == 0);
  CHECK(b->header().version_minor == 1);
  REQUIRE(validate(*b));
  const auto x = load_direct(*a, options), y = load_direct(*b, options);
  REQUIRE(x);
  REQUIRE(y);
  CHECK(y->size() == a->header().n_gaussians);
  check_same(x->means(), y->means());
  check_same(x->geometry(), y->geometry());
  check_same(x->sh(), y->sh());
  check_same(x->chunk_table(), y->chunk_table());
  check_same(x->scale_table(), y->scale_table());
  check_same(a->stored(SectionType::declarations), b->stored(SectionType::declarations));
  check_same(a->stored(SectionType::permutation), b->stored(SectionType::permutation));
  check_same(a->stored(SectionType::provenance), b->stored(SectionType::provenance));
}

}  // namespace

TEST_CASE("packed files decode to the bytes of direct files") {
  for (const GoldenScene& scene : golden_scenes()) {
    CAPTURE(scene.name);
    check_equal(encode_both(scene.cloud, scene.options));
  }
}

TEST_CASE("packed sections of every size around lanes, chunks and frames decode exactly") {
  for (const std::uint64_t n : {1u, 31u, 63u, 64u, 65u, 127u, 128u, 1000u, 16383u, 16384u, 16385u, 40000u}) {
    for (const int degree : {0, 1, 2, 3}) {
      if (n > 2000 && degree != 3 && n != 16385) continue;
      CAPTURE(n);
      CAPTURE(degree);
      EncodeOptions options;
      options.chunk_size = n % 2 == 0 ? 256 : 96;
      options.keep_permutation = n == 1000;
      options.chunk_scales = n != 127;
      SplitMix random{7 * n + static_cast<std::uint64_t>(degree)};
      check_equal(encode_both(random_cloud(n, degree, random), options));
    }
  }
}
