// clusters_test.cpp - clusters of Gaussians to merge, and their moments.
// SPDX-License-Identifier: Apache-2.0
#include "clusters.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "clusters_simd.hpp"
#include "lod_scenes.hpp"

namespace {

using namespace rgs::lod;

constexpr float kCentre[3] = {0, 0, 0};

}  // namespace

TEST_CASE("principal axes restore the covariance") {
  rgs::test::SplitMix random(1);
  for (int round = 0; round < 200; ++round) {
    Gaussians one(1, 0), two(1, 0);
    float norm = 0;
    for (int k = 0; k < 4; ++k) {
      one.of(kRotation + k)[0] = random.dyadic(-1, 1) + 0x1p-13F;
      norm += one.of(kRotation + k)[0] * one.of(kRotation + k)[0];
    }
    for (int k = 0; k < 4; ++k) one.of(kRotation + k)[0] /= std::sqrt(norm);
    for (int k = 0; k < 3; ++k) one.of(kScale + k)[0] = std::exp(random.dyadic(-3, 3));
    const Covariance c = covariance(one, 0);
    float scale[3], rotation[4];
    principal_axes(c, 0, scale, rotation);
    for (int k = 0; k < 3; ++k) two.of(kScale + k)[0] = scale[k];
    for (int k = 0; k < 4; ++k) two.of(kRotation + k)[0] = rotation[k];
    const Covariance d = covariance(two, 0);
    const float size = c.of[0] + c.of[3] + c.of[5];
    for (int k = 0; k < 6; ++k) CHECK(std::abs(c.of[k] - d.of[k]) <= 1e-5F * size);
  }
}

TEST_CASE("the mean cross-section of a ball is that of its disc") {
  Gaussians ball(1, 0);
  ball.of(kRotation)[0] = 1;
  for (int k = 0; k < 3; ++k) ball.of(kScale + k)[0] = 0.5F;
  CHECK(mean_cross_section(covariance(ball, 0)) == doctest::Approx(2 * 3.14159265 * 0.25));
}

TEST_CASE("clusters: every Gaussian is in one, and their number is as requested") {
  rgs::test::SplitMix random(2);
  const rgs::SplatCloud cloud = rgs::test::wall(32, 1, random);
  const Gaussians gaussians = activate(cloud.view(), 0, cloud.size(), kCentre);
  for (const std::size_t n : {1000U, 256U, 3U}) {
    const Clusters clusters = merge_neighbours(gaussians, areas(gaussians), n, 0.05F);
    CHECK(clusters.all.size() == n);
    std::vector<int> found(gaussians.size(), 0);
    for (const Cluster& c : clusters.all) clusters.each_member(c, [&](std::uint32_t i) { ++found[i]; });
    for (const int count : found) CHECK(count == 1);
  }
}

TEST_CASE("what two Gaussians hide of each other is covered once") {
  // Balls. Seen along an axis, two of opacity a that are d apart along both axes of the picture
  // cover 2 pi s^2 (2 a - a^2 / 2 exp(-d^2 / 2 s^2)).
  constexpr float kOpacityOfBoth = 0.8F, kSize = 0.5F;
  for (const float apart : {0.F, 0.5F, 20.F}) {
    Gaussians pair(2, 0);
    for (std::size_t i = 0; i < 2; ++i) {
      pair.of(kRotation)[i] = 1;
      pair.of(kOpacity)[i] = kOpacityOfBoth;
      for (int k = 0; k < 3; ++k) {
        pair.of(kScale + k)[i] = kSize;
        pair.of(kMean + k)[i] = i == 0 ? 0 : apart;
      }
    }
    const Clusters clusters = merge_neighbours(pair, areas(pair), 1, 1e-3F);
    REQUIRE(clusters.all.size() == 1);
    const float hidden = kOpacityOfBoth * kOpacityOfBoth / 2 * std::exp(-apart * apart / (2 * kSize * kSize));
    CHECK(clusters.all[0].weight ==
          doctest::Approx(2 * 3.14159265F * kSize * kSize * (2 * kOpacityOfBoth - hidden)).epsilon(1e-3));
  }
}

TEST_CASE("merged Gaussians cover at least what the largest does, and at most what all do") {
  // A wall, and eight opaque Gaussians at one place: n of them cover 1 + 1/2 + ... + 1/n times what one does.
  rgs::test::SplitMix random(4);
  const rgs::SplatCloud cloud = rgs::test::wall(24, 1, random);
  Gaussians stack(8, 0);
  for (std::size_t i = 0; i < stack.size(); ++i) {
    stack.of(kRotation)[i] = stack.of(kOpacity)[i] = 1;
    for (int k = 0; k < 3; ++k) stack.of(kScale + k)[i] = 1;
  }
  for (const Gaussians& gaussians : {activate(cloud.view(), 0, cloud.size(), kCentre), stack}) {
    const std::vector<float> area = areas(gaussians);
    const Clusters clusters = merge_neighbours(gaussians, area, gaussians.size() / 8, 0.05F);
    for (const Cluster& c : clusters.all) {
      double largest = 0, all = 0;
      clusters.each_member(c, [&](std::uint32_t i) {
        largest = std::max(largest, static_cast<double>(area[i]));
        all += static_cast<double>(area[i]);
      });
      CHECK(static_cast<double>(c.weight) >= 0.999 * largest);
      CHECK(static_cast<double>(c.weight) <= 1.001 * all);
    }
  }
  const double covered = static_cast<double>(merge_neighbours(stack, areas(stack), 1, 0.05F).all[0].opacity);
  CHECK(covered > 2.0);
  CHECK(covered < 5.0);  // 2.7; only pairs are counted exactly
}

TEST_CASE("neighbours of one colour are merged before those of two") {
  // Pairs at equal distances; the two of a pair are both red, both green, or one each.
  constexpr std::size_t kPairs = 60;
  Gaussians gaussians(2 * kPairs, 0);
  for (std::size_t i = 0; i < 2 * kPairs; ++i) {
    gaussians.of(kMean)[i] = static_cast<float>(i / 2) * 10 + static_cast<float>(i % 2);
    gaussians.of(kRotation)[i] = 1;
    gaussians.of(kOpacity)[i] = 0.8F;
    for (int k = 0; k < 3; ++k) gaussians.of(kScale + k)[i] = 0.5F;
    const bool mixed = i / 2 % 2 == 0;
    const bool red = mixed ? i % 2 == 0 : i / 2 % 4 == 1;
    gaussians.of(kSh)[i] = red ? 1.5F : -1.5F;
    gaussians.of(kSh + 1)[i] = red ? -1.5F : 1.5F;
  }
  const Clusters clusters = merge_neighbours(gaussians, areas(gaussians), 2 * kPairs - kPairs / 2, 1);
  for (const Cluster& c : clusters.all) {
    if (clusters.is_single(c)) continue;
    CHECK(c.first / 2 == c.last / 2);
    CHECK(c.first / 2 % 2 == 1);  // of one colour
  }
}

TEST_CASE("the nearest neighbours are those that comparing all finds") {
  for (const std::uint32_t n : {1U, 3U, 8U, 9U, 700U}) {
    CAPTURE(n);
    rgs::test::SplitMix random(n);
    std::vector<Cluster> clusters(n);
    for (Cluster& cluster : clusters) {
      for (float& x : cluster.mean) x = random.dyadic(-1, 1);
    }
    const auto squared = [&](std::uint32_t i, std::uint32_t j) {
      float total = 0;
      for (int k = 0; k < 3; ++k) {
        const float apart = clusters[i].mean[k] - clusters[j].mean[k];
        total += apart * apart;
      }
      return total;
    };
    std::vector<Neighbours> nearest, some;
    nearest_clusters(clusters, 1, nearest);
    for (std::uint32_t i = 0; i < n; ++i) {
      std::vector<float> expected, found;
      for (std::uint32_t j = 0; j < n; ++j) {
        if (j != i) expected.push_back(squared(i, j));
      }
      std::ranges::sort(expected);
      expected.resize(std::min(expected.size(), nearest[i].size()));
      for (const std::uint32_t j : nearest[i]) {
        if (j != kNoNeighbour) found.push_back(squared(i, j));
      }
      CHECK(found == expected);
    }
    nearest_clusters(clusters, 4, some);
    std::size_t n_asked = 0;
    for (std::uint32_t i = 0; i < n; ++i) {
      if (some[i][0] == kNoNeighbour) continue;
      CHECK(some[i] == nearest[i]);
      ++n_asked;
    }
    CHECK(n_asked <= (n + 31) / 32 * 8);
    CHECK((n_asked > 0) == (n > 1));
  }
}

TEST_CASE("many Gaussians at one position are merged in pairs in one round") {
  constexpr std::uint32_t kAlike = 3000, kOthers = 1000;
  rgs::test::SplitMix random(5);
  std::vector<Cluster> clusters(kAlike + kOthers);
  for (std::uint32_t i = 0; i < clusters.size(); ++i) {
    for (float& x : clusters[i].mean) x = i < kAlike ? 0.25F : random.dyadic(-1, 1);
  }
  std::vector<Neighbours> nearest;
  nearest_clusters(clusters, 1, nearest);
  std::vector<char> used(clusters.size(), 0);
  std::uint32_t n_pairs = 0;
  for (std::uint32_t i = 0; i < kAlike; ++i) {
    for (const std::uint32_t j : nearest[i]) {
      REQUIRE(j < kAlike);
      CHECK(j != i);
      if (used[i] != 0 || used[j] != 0) continue;
      used[i] = used[j] = 1;
      ++n_pairs;
    }
  }
  CHECK(n_pairs > kAlike / 4);  // five, if all had the same neighbours
}
