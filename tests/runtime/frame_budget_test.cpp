// frame_budget_test.cpp - the limit of Gaussians that follows what frames took; times are given, not measured.
// SPDX-License-Identifier: Apache-2.0
#include "frame_budget.hpp"

#include <doctest/doctest.h>

#include <cstdint>

using namespace rgs;

namespace {

/// A scene whose cuts shrink by a quarter a step of the detail.
struct World {
  double ms_per_million = 10, ms_besides = 0;
  std::uint64_t all = 8'000'000;
  detail::FrameBudget budget;

  int step() const {
    std::uint64_t n = all;
    int step = 0;
    for (; n > budget.max_gaussians() && n > 1000; ++step) n -= n / 4;
    return step;
  }
  /// What a frame takes.
  double draw(double frame_ms) {
    std::uint64_t n = all;
    for (int k = step(); k > 0; --k) n -= n / 4;
    const double ms = ms_besides + ms_per_million * 1e-6 * static_cast<double>(n);
    budget.drew(ms, frame_ms, n);
    return ms;
  }
};

}  // namespace

TEST_CASE("a frame over its time makes the next one fit, and in a still world the detail then stays") {
  for (const double frame_ms : {60.0, 30.0, 10.0, 1.0}) {
    for (const double besides : {0.0, 0.3}) {
      CAPTURE(frame_ms);
      World world;
      world.ms_besides = besides * frame_ms;
      int n_late = 0;
      for (int k = 0; k < 8; ++k) n_late += world.draw(frame_ms) > frame_ms ? 1 : 0;
      CHECK(n_late >= 1);
      CHECK(n_late <= 4);
      for (int k = 0; k < 50; ++k) world.draw(frame_ms);
      const int step = world.step();
      for (int k = 0; k < 200; ++k) {
        CHECK(world.draw(frame_ms) <= frame_ms);
        CHECK(world.step() == step);
      }
      CHECK(world.draw(frame_ms) > 0.4 * frame_ms);  // the time is used
    }
  }
}

TEST_CASE("the limit falls at once, and rises slowly, up to what there is") {
  World world;
  const std::uint64_t none = world.budget.max_gaussians();
  CHECK(none > world.all);
  world.draw(1000);
  CHECK(world.budget.max_gaussians() == none);  // nothing was limited
  world.budget.drew(1000, 10, 8'000'000);
  CHECK(world.budget.max_gaussians() == 2'000'000);  // one slow frame is not believed altogether
  world.budget.drew(20, 10, 1'600'000);
  CHECK(world.budget.max_gaussians() == 600'000);
  world.budget.drew(7, 10, 600'000);
  CHECK(world.budget.max_gaussians() == 600'000);
  world.budget.drew(2, 10, 600'000);
  CHECK(world.budget.max_gaussians() == 675'001);
  // What fits by the last frame's time is the most.
  world.budget.drew(4.5, 10, 300'000);
  CHECK(world.budget.max_gaussians() == 675'001);
  for (int k = 0; k < 1000; ++k) world.budget.drew(1, 10, 100'000);
  CHECK(world.budget.max_gaussians() == 750'000);
  for (int k = 0; k < 1000; ++k) world.budget.drew(0, 10, 100'000);
  CHECK(world.budget.max_gaussians() > 100 * world.all);
  for (int k = 0; k < 100; ++k) world.budget.drew(1e9, 10, world.budget.max_gaussians());
  CHECK(world.budget.max_gaussians() == 1);
}

TEST_CASE("a slower machine and a larger scene are met by less detail, a faster one by more") {
  World world;
  for (int k = 0; k < 60; ++k) world.draw(16);
  const int before = world.step();
  world.ms_per_million *= 5;
  for (int k = 0; k < 5; ++k) world.draw(16);
  CHECK(world.draw(16) <= 16);
  CHECK(world.step() > before + 3);
  world.ms_per_million /= 5;
  for (int k = 0; k < 60; ++k) CHECK(world.draw(16) <= 16);
  CHECK(world.step() <= before + 1);
}
