// tie_order_math_test.cpp - the tie order is total, depends on values alone, and survives rounding.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/math/tie_order.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

#include "random_views.hpp"

using namespace rgs::math;
using namespace rgs::test;

namespace {

constexpr float kInf = std::numeric_limits<float>::infinity();
constexpr float kTiny = std::numeric_limits<float>::denorm_min();
constexpr float kLargest = std::numeric_limits<float>::max();
const std::vector<float> kAscending = {
    -kInf,  -kLargest, -1.5F, -1,        -std::numeric_limits<float>::min(), -3 * kTiny,
    -kTiny, 0,         kTiny, 3 * kTiny, std::numeric_limits<float>::min(),  1,
    1.5F,   kLargest,  kInf};

struct Gaussian {
  Vec3<float> mean{}, scale{1, 1, 1};
  float opacity = 0.5F;
  Quaternion<float> rotation{1, 0, 0, 0};
  float sh[12] = {};
};
struct Gaussians {
  std::vector<Gaussian> all;

  const Gaussian& at(std::uint32_t i) const { return all[i]; }
  float mean(std::uint32_t i, int axis) const {
    const Vec3<float>& m = at(i).mean;
    return axis == 0 ? m.x : axis == 1 ? m.y : m.z;
  }
  Vec3<float> scale(std::uint32_t i) const { return at(i).scale; }
  Quaternion<float> rotation(std::uint32_t i) const { return at(i).rotation; }
  float opacity(std::uint32_t i) const { return at(i).opacity; }
  int n_sh() const { return 12; }
  float sh(std::uint32_t i, int k) const { return at(i).sh[k]; }
};

// Value k of those that decide, in their order.
float& value(Gaussian& g, int k) {
  if (k < 3) return k == 0 ? g.mean.x : k == 1 ? g.mean.y : g.mean.z;
  if (k == 3) return g.opacity;
  if (k < 7) return k == 4 ? g.scale.x : k == 5 ? g.scale.y : g.scale.z;
  if (k < 10) return g.sh[k - 7];
  if (k < 14) return k == 10 ? g.rotation.w : k == 11 ? g.rotation.x : k == 12 ? g.rotation.y : g.rotation.z;
  return g.sh[k - 11];
}
constexpr int kValues = 23;

// Gaussians with few different values, so that many pairs share most of them.
Gaussians few_values(unsigned seed, int n) {
  Random random(seed);
  Gaussians g;
  for (int i = 0; i < n; ++i) {
    Gaussian one;
    const int n_changed = static_cast<int>(random.uniform(0, 6));
    for (int c = 0; c < n_changed; ++c) {
      const auto which = static_cast<std::size_t>(random.uniform(0, static_cast<double>(kAscending.size())));
      value(one, static_cast<int>(random.uniform(0, kValues))) = random.uniform(0, 10) < 1 ? -0.0F : kAscending[which];
    }
    g.all.push_back(one);
  }
  return g;
}

}  // namespace

TEST_CASE("bits order like the numbers, and both zeros are equal") {
  for (std::size_t i = 0; i + 1 < kAscending.size(); ++i) {
    CHECK(order_bits(kAscending[i]) < order_bits(kAscending[i + 1]));
  }
  CHECK(order_bits(-0.0F) == order_bits(0.0F));
  CHECK(order_bits(std::numeric_limits<float>::quiet_NaN()) > order_bits(kInf));
}

TEST_CASE("the tie order is total: of two exactly one comes first, and it is transitive") {
  const Gaussians g = few_values(1402, 160);
  const auto n = static_cast<std::uint32_t>(g.all.size());
  int n_equal = 0;
  for (std::uint32_t a = 0; a < n; ++a) {
    CHECK_FALSE(ties_before(g, a, a));
    for (std::uint32_t b = 0; b < n; ++b) {
      if (a == b) continue;
      CHECK(ties_before(g, a, b) != ties_before(g, b, a));
      CHECK(compare_ties(g, a, b) == -compare_ties(g, b, a));
      n_equal += compare_ties(g, a, b) == 0 ? 1 : 0;
      for (std::uint32_t c = 0; c < n; ++c) {
        if (ties_before(g, a, b) && ties_before(g, b, c)) REQUIRE(ties_before(g, a, c));
      }
    }
  }
  CHECK(n_equal > 0);
}

TEST_CASE("every value decides, earlier ones first") {
  for (int k = 0; k < kValues; ++k) {
    CAPTURE(k);
    Gaussians g{{Gaussian(), Gaussian()}};
    value(g.all[1], k) += 0.25F;
    CHECK(compare_ties(g, 0, 1) == -1);
    CHECK(compare_ties(g, 1, 0) == 1);
    for (int later = k + 1; later < kValues; ++later) value(g.all[1], later) -= 0.25F;
    CHECK(compare_ties(g, 0, 1) == -1);
  }
}

TEST_CASE("the tie order does not depend on the Gaussians' positions in the scene") {
  Gaussians g = few_values(1403, 2000);
  const auto ordered = [](const Gaussians& scene) {
    std::vector<std::uint32_t> order(scene.all.size());
    std::iota(order.begin(), order.end(), 0u);
    std::sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) { return ties_before(scene, a, b); });
    std::vector<std::uint32_t> bits;
    for (const std::uint32_t i : order) {
      Gaussian one = scene.all[i];
      for (int k = 0; k < kValues; ++k) bits.push_back(order_bits(value(one, k)));
    }
    return bits;
  };
  const auto expected = ordered(g);
  for (const unsigned seed : {1u, 2u, 3u}) {
    std::shuffle(g.all.begin(), g.all.end(), std::mt19937(seed));
    CHECK(ordered(g) == expected);
  }
}

TEST_CASE("moving a scene or rounding its values does not swap two Gaussians that still differ") {
  Random random(1404);
  Gaussians g = few_values(1404, 300);
  for (Gaussian& one : g.all) {
    for (int k = 0; k < 3; ++k) value(one, k) = static_cast<float>(std::floor(random.uniform(-3, 3))) / 4;
  }
  Gaussians moved = g;
  for (Gaussian& one : moved.all) {
    one.mean = {one.mean.x + 1000.3F, one.mean.y * 0.1F, one.mean.z - 77.7F};
    one.opacity = std::round(one.opacity * 16) / 16;
  }
  for (std::uint32_t a = 0; a < 300; ++a) {
    for (std::uint32_t b = 0; b < 300; ++b) {
      const auto of_mean_and_opacity = [&](const Gaussians& scene) {
        for (int k = 0; k < 4; ++k) {
          Gaussian x = scene.at(a), y = scene.at(b);
          if (const int c = compare_values(value(x, k), value(y, k)); c != 0) return c;
        }
        return 0;
      };
      const int after = of_mean_and_opacity(moved);
      if (after != 0) CHECK(after == compare_ties(g, a, b));
      if (after != 0) CHECK(after == compare_ties(moved, a, b));
    }
  }
}
