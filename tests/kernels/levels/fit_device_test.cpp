// fit_device_test.cpp - levels fitted on the device are as near to their group as those of the processor.
// SPDX-License-Identifier: Apache-2.0
#include "fit_device.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <thread>
#include <vector>

#include "device_fixture.hpp"
#include "fit.hpp"
#include "lod_scenes.hpp"
#include "simplify.hpp"
#include "views.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

lod::Gaussians wall_of(std::uint64_t side, int sh_degree) {
  SplitMix random(7);
  const SplatCloud cloud = wall(side, sh_degree, random);
  const float centre[3] = {0.5F, 0.5F, 0};
  return lod::activate(cloud.view(), 0, cloud.size(), centre);
}

bool same_bits(const lod::Gaussians& a, const lod::Gaussians& b) {
  const std::size_t n = static_cast<std::size_t>(a.n_values()) * a.padded();
  return a.n_values() == b.n_values() && a.padded() == b.padded() && std::memcmp(a.of(0), b.of(0), 4 * n) == 0;
}

// From other directions than those of the fit.
double squared_difference(const lod::Gaussians& group, const lod::Gaussians& result, float pixel) {
  lod::Projection projection;
  lod::Picture fine, truth, drawn;
  double total = 0;
  for (int i = 0; i < 5; ++i) {
    const lod::Frame frame = lod::frame_around(group, lod::direction(i, 5), pixel, 256);
    lod::true_picture(group, frame, 4, projection, fine, truth);
    lod::project(result, frame, lod::kDrawn, projection);
    drawn.resize(frame.width, frame.height);
    lod::draw(projection.dots, drawn);
    total += lod::difference(truth, drawn).squared;
  }
  return total;
}

}  // namespace

TEST_CASE("levels: colours fitted on the device are as near to the group as those fitted on the processor") {
  if (!device_answers()) return;
  for (const int sh_degree : {0, 1, 2, 3}) {
    CAPTURE(sh_degree);
    const std::uint64_t side = small_sizes() ? 16 : 40;
    const lod::Gaussians group = wall_of(side, sh_degree);
    const std::size_t n = group.size() / 4;
    const float pixel = 2 / static_cast<float>(side) * 2;
    const lod::Gaussians before = lod::simplify(group, n, lod::Quality::fast).gaussians;
    lod::Gaussians on_host = before, on_device = before;
    lod::fit_colors(group, on_host, pixel);
    auto device = lod::FitDevice::create();
    require_ok(device);
    (*device)->fit_colors(group, on_device, pixel);
    require_ok((*device)->status());

    const double unfitted = squared_difference(group, before, pixel);
    const double by_host = squared_difference(group, on_host, pixel);
    const double by_device = squared_difference(group, on_device, pixel);
    CAPTURE(unfitted);
    CAPTURE(by_host);
    CHECK(by_host < (small_sizes() ? 1 : 0.95) * unfitted);
    CHECK(std::abs(by_device - by_host) < 0.01 * by_host);
    // Means, scales and rotations stay.
    CHECK(std::memcmp(before.of(0), on_device.of(0), 4 * lod::kOpacity * before.padded()) == 0);
  }
}

TEST_CASE("levels: all Gaussians in one pixel, and a single one, are fitted on the device as on the processor") {
  if (!device_answers()) return;
  auto device = lod::FitDevice::create();
  require_ok(device);
  for (const int side : {40, 2}) {
    const int n = side * side / 4;
    CAPTURE(n);
    const lod::Gaussians group = wall_of(static_cast<std::uint64_t>(side), 1);
    const lod::Gaussians before = lod::simplify(group, static_cast<std::size_t>(n), lod::Quality::fast).gaussians;
    lod::Gaussians on_host = before, on_device = before;
    lod::fit_colors(group, on_host, 1);
    (*device)->fit_colors(group, on_device, 1);
    require_ok((*device)->status());
    const double by_host = squared_difference(group, on_host, 1), by_device = squared_difference(group, on_device, 1);
    CHECK_FALSE(same_bits(on_device, before));
    CHECK(std::abs(by_device - by_host) < 0.02 * by_host);
  }
}

TEST_CASE("levels: a fit that overflows is not finite, on the device as on the processor") {
  if (!device_answers()) return;
  lod::Gaussians group = wall_of(8, 0);
  lod::Gaussians before = lod::simplify(group, group.size() / 4, lod::Quality::fast).gaussians;
  for (std::size_t i = 0; i < group.size(); ++i) group.of(lod::kSh)[i] = 1e30F;
  for (std::size_t i = 0; i < before.size(); ++i) before.of(lod::kSh)[i] = -1e30F;
  before.of(lod::kSh)[0] = 1e38F;
  auto device = lod::FitDevice::create();
  require_ok(device);
  (*device)->fit_colors(group, before, 0.25F);
  require_ok((*device)->status());
  const float* const harmonics = before.of(lod::kSh);
  CHECK_FALSE(std::all_of(harmonics, harmonics + before.size(), [](float x) { return std::isfinite(x); }));
}

TEST_CASE("levels: threads that fit at once get the bits of one") {
  if (!device_answers()) return;
  const lod::Gaussians group = wall_of(small_sizes() ? 12 : 32, 2);
  const lod::Gaussians before = lod::simplify(group, group.size() / 4, lod::Quality::fast).gaussians;
  auto device = lod::FitDevice::create();
  require_ok(device);
  std::vector<lod::Gaussians> fitted(8, before);
  std::vector<std::thread> threads;
  for (lod::Gaussians& one : fitted) threads.emplace_back([&] { (*device)->fit_colors(group, one, 0.1F); });
  for (std::thread& thread : threads) thread.join();
  require_ok((*device)->status());
  CHECK_FALSE(same_bits(fitted[0], before));
  for (const lod::Gaussians& one : fitted) CHECK(same_bits(one, fitted[0]));
}
