// prune_test.cpp - ranking by contribution: shares, counts, ties, thresholds, and the NumPy file.
// SPDX-License-Identifier: Apache-2.0
#include "prune.hpp"

#include <doctest/doctest.h>

#include <cstring>
#include <string>

using namespace rgs;
using namespace rgs::prune;

namespace {

using Indices = std::vector<std::uint64_t>;

/// Sums 5, 1, 3, 3, 0 and maxima 0.125, 0.75, 0.5, 0.5, 0.
std::vector<Contribution> sample() {
  const auto units = [](double weight) { return static_cast<std::uint64_t>(weight / Contribution::kUnit); };
  return {{units(5), 0.125F}, {units(1), 0.75F}, {units(3), 0.5F}, {units(3), 0.5F}, {0, 0}};
}

}  // namespace

TEST_CASE("--keep takes a percentage or a count") {
  CHECK(parse_keep("20%")->of(1000) == 200);
  CHECK(parse_keep("0.5%")->of(1000) == 5);
  CHECK(parse_keep("100%")->of(1000) == 1000);
  CHECK(parse_keep("0%")->of(1000) == 0);
  CHECK(parse_keep("20%")->of(3) == 1);  // 0.6, rounded
  CHECK(parse_keep("100k")->of(778812) == 100000);
  CHECK(parse_keep("300")->of(200) == 200);
  for (const char* wrong : {"", "%", "101%", "-1%", "nan%", "20 %", "x", "1.5", "20%%"}) {
    CAPTURE(wrong);
    const auto keep = parse_keep(wrong);
    REQUIRE_FALSE(keep);
    CHECK(keep.error().code == Errc::bad_argument);
  }
}

TEST_CASE("the highest scores are kept in scene order, and earlier Gaussians win ties") {
  const auto c = sample();
  CHECK(highest(c, Score::sum, 1) == Indices{0});
  CHECK(highest(c, Score::sum, 2) == Indices{0, 2});
  CHECK(highest(c, Score::sum, 3) == Indices{0, 2, 3});
  CHECK(highest(c, Score::max, 1) == Indices{1});
  CHECK(highest(c, Score::max, 2) == Indices{1, 2});
  CHECK(highest(c, Score::max, 4) == Indices{0, 1, 2, 3});
  CHECK(highest(c, Score::sum, 9) == Indices{0, 1, 2, 3, 4});
  CHECK(highest(c, Score::sum, 0).empty());
  CHECK(highest({}, Score::sum, 3).empty());
}

TEST_CASE("a threshold keeps every score that reaches it") {
  const auto c = sample();
  CHECK(at_least(c, Score::sum, 3) == Indices{0, 2, 3});
  CHECK(at_least(c, Score::max, 0.5) == Indices{1, 2, 3});
  CHECK(at_least(c, Score::sum, 0).size() == 5);
  CHECK(at_least(c, Score::sum, 6).empty());
}

TEST_CASE("the outcome states the share of weight kept") {
  const auto c = sample();
  const Outcome kept = outcome(c, Score::sum, Indices{0, 2});
  CHECK(kept.n_kept == 2);
  CHECK(kept.n_unseen == 1);
  CHECK(kept.weight_share == doctest::Approx(8.0 / 12));
  CHECK(kept.lowest_score == doctest::Approx(3));
  CHECK(outcome(c, Score::max, Indices{0, 2}).lowest_score == doctest::Approx(0.125));
  const Outcome none = outcome({}, Score::sum, {});
  CHECK(none.weight_share == 1);
  CHECK(none.lowest_score == 0);
}

TEST_CASE("scores are written as a NumPy file") {
  const auto bytes = scores_npy(sample());
  const std::string text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  CHECK(text.substr(0, 8) == std::string("\x93NUMPY\x01\0", 8));
  const auto byte = [&](std::size_t i) { return static_cast<std::size_t>(bytes[i]); };
  const std::size_t head = 10 + byte(8) + 256 * byte(9);
  CHECK(head % 64 == 0);
  CHECK(text[head - 1] == '\n');
  CHECK(text.find("'shape': (5, 2)") < head);
  REQUIRE(bytes.size() == head + 5 * 2 * sizeof(double));
  double values[10];
  std::memcpy(values, bytes.data() + head, sizeof values);
  CHECK(values[0] == 5);
  CHECK(values[1] == 0.125);
  CHECK(values[2] == 1);
  CHECK(values[9] == 0);
}
