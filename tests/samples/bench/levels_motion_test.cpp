// levels_motion_test.cpp - levels of detail do not pop more than the truth while the camera moves.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "build_levels.hpp"
#include "levels_motion.hpp"
#include "renderer_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "town_generator.hpp"

using namespace rgs;
using namespace rgs::bench;
using namespace rgs::test;

namespace {

constexpr int kFrames = 120;

SplatCloud town(std::uint64_t n) {
  const TownGenerator generator(1, n, 1);
  std::vector<Splat> splats;
  for (std::uint64_t k = 0; k < generator.n_ranges(); ++k) {
    const TownRange range = generator.range(k);
    std::vector<Splat> part(range.size());
    range.generate(0, part);
    splats.insert(splats.end(), part.begin(), part.end());
  }
  return cloud_of(splats, 1);
}

/// With the settings of rgs-convert --lod.
Scene scene_with_levels(std::uint64_t n) {
  const auto plain = encode(town(n).view(), {});
  REQUIRE(plain);
  const auto leaves = decode(*plain);
  REQUIRE(leaves);
  EncodeOptions options;
  options.order = Order::morton;
  std::vector<std::byte> file;
  REQUIRE(write_levels(lod::build_levels(leaves->view()), options, file));
  auto scene = Scene::load(file);
  REQUIRE(scene);
  return *std::move(scene);
}

}  // namespace

TEST_CASE("the largest jump is the frame where a sequence's step most exceeds the truth's") {
  const std::vector<Change> truth{{1, 10, 0, 0}, {2, 20, 0, 0}, {4, 40, 0, 0}};
  const std::vector<Change> steps{{1, 10, 0, 0}, {3, 22, 0, 0}, {4, 60, 0, 0}};
  const Jump jump = largest_jump(steps, truth);
  CHECK(jump.mean == 1.5);
  CHECK(jump.mean_frame == 2);
  CHECK(jump.p999 == 1.5);
  CHECK(jump.p999_frame == 3);
}

TEST_CASE("a dolly moves straight back from a point, by one factor per frame") {
  Camera camera;
  camera.width = camera.height = 10;
  camera.world_to_camera[3] = {0.5, 0, 4, 1};
  const auto path = dolly(camera, 4, 16, 5);
  REQUIRE(path.size() == 5);
  for (std::size_t i = 0; i < 5; ++i) {
    CHECK(path[i].world_to_camera[3].x == 0.5);
    CHECK(path[i].world_to_camera[3].z == doctest::Approx(4 * std::pow(2, i)));  // where the point was 4 ahead
  }
}

TEST_CASE(
    "levels of detail do not pop: a dolly to 16 times the distance and an orbit, against the supersampled truth") {
  if (kSanitized) return skip("a thousand pictures take too long with sanitizers");
  const Scene scene = scene_with_levels(120000);
  REQUIRE(scene.levels()->n_levels() >= 3);
  const auto set = parse_camera_json(town_cameras_json(1, 96, 54));
  REQUIRE(set);
  // Over the roofs: near and far in one picture.
  const Camera& camera = set->cameras[4];
  auto renderer = Renderer::create({Backend::cpu});
  REQUIRE(renderer);
  std::vector<float> depth(96 * 54);
  REQUIRE(renderer->render(scene, camera, {.depth = depth}));
  const double distance = look_at_distance(depth);
  const Camera far = dolly(camera, distance, 4, 2).back();

  LevelsMotion motion(scene, 8);
  // Both far enough that the cut changes on the way.
  const std::pair<std::string, std::vector<Camera>> paths[] = {{"dolly", dolly(camera, distance, 16, kFrames)},
                                                               {"orbit", turntable(far, 4 * distance, 0.5, kFrames)}};
  for (const auto& [name, path] : paths) {
    const auto truth = motion.truth(path), leaves = motion.leaves(path), levels = motion.levels(path, kDefaultDetailPx);
    REQUIRE(truth);
    REQUIRE(leaves);
    REQUIRE(levels);
    const double all = unsteadiness(leaves->whole, truth->whole), found = unsteadiness(levels->whole, truth->whole);
    const Jump jump = largest_jump(levels->steps, truth->steps);
    MESSAGE(name, ": drawn ", levels->drawn, ", pages change ", levels->n_changes, " times, the largest step is ",
            found, " of the truth's, of all compensated ", all, ", between two frames ", jump.mean, " (frame ",
            jump.mean_frame, ")");
    CHECK(levels->n_changes > 0);
    CHECK(levels->drawn < 0.9);
    CHECK(found <= 1.2 * std::max(1.0, all));  // drawing all of them steps farther than an average over pixels
    CHECK(jump.mean <= 1.2);
    // The measure detects popping: half of the way at the default detail, and then the root.
    std::vector<float> details(path.size(), kDefaultDetailPx);
    std::fill(details.begin() + kFrames / 2, details.end(), 1e6F);
    const auto popped = motion.levels(path, details);
    REQUIRE(popped);
    CHECK(largest_jump(popped->steps, truth->steps).mean > 1.2);
    const std::size_t to_root = kFrames / 2 - 1;
    CHECK(popped->steps[to_root].mean > 1.2 * truth->steps[to_root].mean);
  }
}
