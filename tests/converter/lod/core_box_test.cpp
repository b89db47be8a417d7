// core_box_test.cpp - the core of a page ignores floaters and large faint Gaussians, and keeps Gaussians that cover.
// SPDX-License-Identifier: Apache-2.0
#include "core_box.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <cstdint>
#include <limits>

#include "golden_scenes.hpp"

namespace {

using rgs::lod::core_of;

// Gaussians at x = 0, 1, 2, ..., y = -x and z = 7. All equal.
rgs::SplatCloud row(std::uint64_t n) {
  rgs::SplatCloud cloud;
  cloud.resize(n, 0);
  for (std::uint64_t i = 0; i < n; ++i) {
    const auto x = static_cast<float>(i);
    cloud.mean[3 * i] = x, cloud.mean[3 * i + 1] = -x, cloud.mean[3 * i + 2] = 7;
    cloud.rotation[4 * i] = 1;
  }
  return cloud;
}

}  // namespace

TEST_CASE("a core leaves out at most a twentieth on each side") {
  const rgs::SplatCloud cloud = row(100);
  const rgs::Box box = core_of(cloud.view(), 0, 100);
  CHECK(box.min == std::array<float, 3>{5, -94, 7});
  CHECK(box.max == std::array<float, 3>{94, -5, 7});
  const rgs::Box part = core_of(cloud.view(), 40, 10);
  CHECK(part.min == std::array<float, 3>{40, -49, 7});
  CHECK(part.max == std::array<float, 3>{49, -40, 7});
  const rgs::Box one = core_of(cloud.view(), 8, 1);
  CHECK(one.min == std::array<float, 3>{8, -8, 7});
  CHECK(one.max == one.min);
}

TEST_CASE("a core holds few Gaussians that cover much, and no invisible ones") {
  rgs::SplatCloud cloud = row(100);
  for (std::size_t k = 0; k < 3; ++k) cloud.log_scale[3 * 99 + k] = 2;  // 55 times the area
  CHECK(core_of(cloud.view(), 0, 100).max[0] == 99);
  cloud.opacity_logit[99] = -20;
  CHECK(core_of(cloud.view(), 0, 100).max[0] == 94);
  // All are invisible: the core lies anywhere among the means.
  cloud.log_scale.assign(cloud.log_scale.size(), -800);
  const rgs::Box none = core_of(cloud.view(), 0, 100);
  for (std::size_t k = 0; k < 3; ++k) CHECK(none.min[k] <= none.max[k]);
  CHECK(none.min[0] >= 0);
  CHECK(none.max[0] <= 99);
}

TEST_CASE("neither the order of Gaussians nor equal means change a core") {
  rgs::test::SplitMix random(3);
  rgs::SplatCloud cloud = rgs::test::golden_cloud(300, 0, 12);
  for (std::size_t i = 0; i < 100; ++i) cloud.mean[3 * i] = 0.25F;
  const rgs::Box box = core_of(cloud.view(), 0, 300);
  rgs::SplatCloud turned = cloud;
  for (std::uint64_t i = 0; i < 300; ++i) turned.set(i, cloud.view().splat(299 - i));
  const rgs::Box other = core_of(turned.view(), 0, 300);
  for (std::size_t k = 0; k < 3; ++k) {
    CHECK(box.min[k] == doctest::Approx(other.min[k]));
    CHECK(box.max[k] == doctest::Approx(other.max[k]));
  }
}
