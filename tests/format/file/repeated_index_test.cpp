// repeated_index_test.cpp - repeated positions are found in small and in large sources.
// SPDX-License-Identifier: Apache-2.0
#include "file/repeated_index.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <random>
#include <set>
#include <vector>

using rgs::detail::has_repeated_index;

namespace {

bool is_repeated(const std::vector<std::uint64_t>& indices, std::uint64_t n_source) {
  return has_repeated_index(indices.size(), n_source, [&indices](std::uint64_t i) { return indices[i]; });
}

}  // namespace

TEST_CASE("a repeated index is found in small and in large sources") {
  std::mt19937_64 random(7);
  CHECK_FALSE(is_repeated({}, 0));
  CHECK_FALSE(is_repeated({0}, 1));
  CHECK(is_repeated({0, 0}, 1));
  // Near the size from which indices are sorted, 64 per Gaussian, and the largest that a file can declare.
  constexpr std::uint64_t kCount = 100;
  for (const std::uint64_t n_source : {kCount, 64 * kCount - 1, 64 * kCount + 63, 64 * kCount + 64, 6401 * kCount,
                                       std::numeric_limits<std::uint64_t>::max()}) {
    CAPTURE(n_source);
    std::set<std::uint64_t> all{0, n_source - 1};  // both ends
    while (all.size() < kCount) all.insert(random() % n_source);
    std::vector<std::uint64_t> indices(all.begin(), all.end());
    std::shuffle(indices.begin(), indices.end(), random);
    CHECK_FALSE(is_repeated(indices, n_source));
    for (const std::uint64_t value : {indices[3], std::uint64_t{0}, n_source - 1}) {
      std::vector<std::uint64_t> twice = indices;
      twice[twice[50] == value ? 51 : 50] = value;
      CHECK(is_repeated(twice, n_source));
    }
  }
}
