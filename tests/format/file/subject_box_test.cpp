// subject_box_test.cpp - what a scene is about does not depend on floaters, order or quantisation.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/subject_box.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <random>
#include <vector>

using namespace rgs;

namespace {

struct Means {
  std::vector<float> mean, opacity;
  void add(float x, float y, float z, float a) {
    mean.insert(mean.end(), {x, y, z});
    opacity.push_back(a);
  }
  Box box() const { return subject_box(mean, opacity); }
};

// A subject of sides 4, 2 and 1 at (10, -5, 0).
Means subject(int n = 20000) {
  Means out;
  std::mt19937 random(3);
  std::uniform_real_distribution<float> one(-0.5F, 0.5F);
  for (int i = 0; i < n; ++i) {
    const float x = one(random), y = one(random), z = one(random);
    out.add(10 + 4 * x, 2 * y - 5, z, 0.5F + one(random));
  }
  return out;
}

// Largest difference of two boxes as a share of the first one's longest side.
double difference(const Box& a, const Box& b) {
  double side = 0, most = 0;
  for (std::size_t k = 0; k < 3; ++k) {
    side = std::max(side, static_cast<double>(a.max[k]) - static_cast<double>(a.min[k]));
    most = std::max({most, std::abs(static_cast<double>(a.min[k]) - static_cast<double>(b.min[k])),
                     std::abs(static_cast<double>(a.max[k]) - static_cast<double>(b.max[k]))});
  }
  return most / side;
}

}  // namespace

TEST_CASE("the subject's box is where Gaussians are dense and opaque") {
  const Box box = subject().box();
  const Box expected{{8.08F, -5.96F, -0.48F}, {11.92F, -4.04F, 0.48F}};  // without 2 % at either end
  CHECK(difference(expected, box) < 0.01);
}

TEST_CASE("floaters and a background do not move the subject's box") {
  const Means alone = subject();
  Means scene = alone;
  std::mt19937 random(4);
  std::normal_distribution<float> normal;
  std::uniform_real_distribution<float> radius(20, 300);
  for (int i = 0; i < 8000; ++i) {  // a sky: 2 Gaussians in 7
    const float x = normal(random), y = normal(random), z = normal(random);
    const float r = radius(random) / std::hypot(x, y, z);
    scene.add(10 + r * x, r * y, r * z, 0.6F);
  }
  for (int i = 0; i < 3000; ++i) scene.add(10 + 20 * normal(random), 20 * normal(random), 20 * normal(random), 0.05F);
  for (int i = 0; i < 20; ++i) scene.add(1e6F, -3e38F, 1e9F, 1);
  scene.add(std::numeric_limits<float>::quiet_NaN(), 0, 0, 1);
  scene.add(0, std::numeric_limits<float>::infinity(), 0, 1);
  scene.add(10, -5, 0, std::numeric_limits<float>::quiet_NaN());
  CHECK(difference(alone.box(), scene.box()) < 0.02);
}

TEST_CASE("the order of Gaussians does not move the subject's box, and quantisation hardly") {
  const Means scene = subject();
  std::vector<std::size_t> order(scene.opacity.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::mt19937 random(5);
  std::shuffle(order.begin(), order.end(), random);
  Means shuffled, quantised;
  for (const std::size_t i : order) {
    shuffled.add(scene.mean[3 * i], scene.mean[3 * i + 1], scene.mean[3 * i + 2], scene.opacity[i]);
    const auto rounded = [](float x, float step) { return std::round(x / step) * step; };
    quantised.add(rounded(scene.mean[3 * i], 1e-4F), rounded(scene.mean[3 * i + 1], 1e-4F),
                  rounded(scene.mean[3 * i + 2], 1e-4F), rounded(scene.opacity[i], 1.F / 2048));
  }
  CHECK(shuffled.box().min == scene.box().min);
  CHECK(shuffled.box().max == scene.box().max);
  CHECK(difference(scene.box(), quantised.box()) < 2e-4);
}

TEST_CASE("a subject on a floor, of few Gaussians, or of none has a box") {
  Means floor = subject();  // stands on a floor that holds most means
  std::mt19937 random(6);
  std::uniform_real_distribution<float> one(-3, 3);
  for (int i = 0; i < 30000; ++i) floor.add(10 + one(random), -4, one(random), 0.5F);
  CHECK(floor.box().min[1] < -5.8F);

  Means few;
  few.add(0, 0, 0, 1);
  few.add(4, 1, 2, 0.1F);
  CHECK(few.box().min == std::array{0.F, 0.F, 0.F});
  CHECK(few.box().max == std::array{4.F, 1.F, 2.F});
  Means point;
  for (int i = 0; i < 100; ++i) point.add(1, 2, 3, 0);
  CHECK(point.box().min == std::array{1.F, 2.F, 3.F});
  CHECK(point.box().max == std::array{1.F, 2.F, 3.F});
  CHECK(Means().box().min == std::array{-0.5F, -0.5F, -0.5F});
  CHECK(Means().box().max == std::array{0.5F, 0.5F, 0.5F});
}

TEST_CASE("a table of few pages tells where the whole scene is") {
  std::vector<lod::Page> pages(4);
  for (lod::Page& page : pages) page.count = 100, page.core = {{10, 0, 10}, {90, 5, 70}};
  pages[0].n_children = 3, pages[0].first_child = 1;
  pages[0].core = pages[1].core = {{-100, -90, -80}, {100, 0, 80}};
  const Box box = subject_box(pages);
  CHECK(box.min == pages[0].core.min);
  CHECK(box.max == pages[0].core.max);
}
