// orbit_motion_test.cpp - the arc of cameras, and the distinction of popping from motion, on the CPU.
// SPDX-License-Identifier: Apache-2.0
#include "orbit_motion.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <glm/geometric.hpp>
#include <numbers>

#include "renderer_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/renderer.hpp"
#include "scene_generator.hpp"

using namespace rgs;
using namespace rgs::bench;

namespace {

/// A frame of `width` pixels of a wave that moves by `speed` pixels per frame.
std::vector<float> wave(int width, int frame, double speed) {
  std::vector<float> pixels;
  for (int x = 0; x < width; ++x)
    pixels.push_back(static_cast<float>(0.5 + 0.5 * std::sin(0.02 * (x - speed * frame))));
  return pixels;
}

Scene generated_scene(std::uint64_t n) {
  const SceneGenerator generator(7, n, 1);
  std::vector<Splat> splats(n);
  generator.generate(0, splats);
  return test::scene_of(test::cloud_of(splats, 1));
}

std::vector<OrbitRow> orbit_on_cpu(const std::vector<RenderOptions>& modes, int frames) {
  const Scene scene = generated_scene(8000);
  const Camera camera = parse_camera_json(scene_cameras_json(160, 90))->cameras.front();
  auto renderer = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  std::vector<float> depth(160 * 90);
  REQUIRE(renderer->render(scene, camera, {.depth = depth}));
  const auto path = turntable(camera, look_at_distance(depth), 0.25, frames);
  const auto rows = follow(path, std::vector<std::string>(modes.size(), "mode"),
                           [&](std::size_t mode, const Camera& view) -> Result<Image> {
                             Image image = Image::make(view.width, view.height, 3);
                             const auto stats = renderer->render(scene, view, {.rgb = image.pixels}, modes[mode]);
                             if (!stats) return tl::unexpected(stats.error());
                             return image;
                           });
  REQUIRE(rows);
  return *rows;
}

}  // namespace

TEST_CASE("the orbit's centre is at the median of the visible depths") {
  CHECK(look_at_distance(std::vector<float>{0, 5, 0, 1, 3, 0}) == 3);
  CHECK(look_at_distance(std::vector<float>{0, 0}) == 1);
  CHECK(look_at_distance({}) == 1);
}

TEST_CASE("an arc keeps its centre, distance and pace") {
  const Camera camera = look_at({1, -2, -6}, {0.5, 0, 1}, kWorldUp, {.width = 200, .height = 100});
  const double distance = 5;
  const glm::dvec3 target = camera_centre(camera) + distance * camera_axis(camera, 2);
  const auto path = turntable(camera, distance, 0.5, 61);
  REQUIRE(path.size() == 61);
  for (int k = 0; k < 4; ++k) CHECK(glm::distance(path[30].world_to_camera[k], camera.world_to_camera[k]) < 1e-11);
  for (std::size_t i = 0; i < path.size(); ++i) {
    CHECK(validate(path[i]));
    CHECK(glm::distance(path[i].world_to_camera * glm::dvec4(target, 1), glm::dvec4(0, 0, distance, 1)) < 1e-9);
    if (i == 0) continue;
    const double cosine = glm::dot(camera_axis(path[i - 1], 2), camera_axis(path[i], 2));
    CHECK(std::acos(std::min(1.0, cosine)) * 180 / std::numbers::pi == doctest::Approx(0.5).epsilon(1e-6));
  }
  CHECK(turntable(camera, 1, 1, 0).empty());
}

TEST_CASE("steps and second differences of known sequences") {
  MotionMeter still;
  for (int t = 0; t < 5; ++t) still.add(wave(100, 0, 1));
  CHECK(still.step().largest == 0);
  CHECK(still.second().p999 == 0);

  // A ramp in time: every step is 1/64, there is no second difference.
  MotionMeter ramp;
  for (int t = 0; t < 4; ++t) ramp.add(std::vector<float>(2000, static_cast<float>(t) / 64));
  CHECK(ramp.step().mean == 1.0 / 64);
  CHECK(ramp.step().p999 == 1.0 / 64);
  CHECK(ramp.step().largest == 1.0F / 64);
  CHECK(ramp.second().largest == 0);

  // 3 of 2000 pixels jump once in 6 frames by 1/2: above the percentile in one step and in two second differences.
  MotionMeter jump;
  for (int t = 0; t < 6; ++t) {
    std::vector<float> picture(2000, 0.25F);
    if (t >= 3) std::fill_n(picture.begin() + 7, 3, 0.75F);
    jump.add(picture);
  }
  CHECK(jump.step().largest == 0.5F);
  CHECK(jump.step().worst_p999 == 0.5);
  CHECK(jump.step().p999 == doctest::Approx(0.5 / 5));
  CHECK(jump.step().mean == doctest::Approx(0.5 * 3 / 2000 / 5));
  CHECK(jump.second().worst_p999 == 0.5);
  CHECK(jump.second().p999 == doctest::Approx(2 * 0.5 / 4));

  // Two of 2000 are below the percentile.
  MotionMeter rare;
  rare.add(std::vector<float>(2000, 0.0F));
  std::vector<float> picture(2000, 0.0F);
  picture[0] = picture[1999] = 1;
  rare.add(picture);
  CHECK(rare.step().p999 == 0);
  CHECK(rare.step().largest == 1);
}

TEST_CASE("a jump stands out from motion: in second differences, and most in the part added to a steady mode") {
  const std::vector<std::string> modes{"steady", "same", "popping"};
  Camera frame;
  std::vector<Camera> path;
  for (int t = 0; t < 20; ++t) {
    frame.name = std::to_string(t);
    path.push_back(frame);
  }
  const auto rows = follow(path, modes, [](std::size_t mode, const Camera& camera) -> Result<Image> {
    const int t = std::stoi(camera.name);
    Image image{4000, 1, 1, wave(4000, t, 4)};
    if (mode == 2 && t >= 10) std::for_each_n(image.pixels.begin() + 400, 40, [](float& v) { v += 0.05F; });
    return image;
  });
  REQUIRE(rows);
  const OrbitRow &steady = (*rows)[0], &same = (*rows)[1], &popping = (*rows)[2];
  CHECK(steady.mode == "steady");
  CHECK(unsteadiness(same, steady) == 1);
  CHECK(same.added.largest == 0);
  CHECK(popping.second.worst_p999 > 5 * steady.second.worst_p999);
  CHECK(unsteadiness(popping, steady) > 5);
  CHECK(popping.added.worst_p999 == doctest::Approx(0.05).epsilon(2e-3));
  CHECK(popping.added.mean < 0.001);
}

TEST_CASE("a failing frame ends the path") {
  const auto rows =
      follow(std::vector<Camera>(3), std::vector<std::string>{"a"}, [](std::size_t, const Camera&) -> Result<Image> {
        return make_error(Errc::device_failed, Error::kNone, "lost");
      });
  REQUIRE_FALSE(rows);
  CHECK(rows.error().code == Errc::device_failed);
}

TEST_CASE("turbo's definition is as steady as baseline's on an orbit; a coarse depth key pops") {
  RenderOptions coarse{.pipeline = Pipeline::paper, .paper = steps_of(test::baseline_options(), Backend::cpu)};
  coarse.paper.depth_order = math::DepthOrder::quantized;
  coarse.paper.depth_bits = 10;
  const auto rows = orbit_on_cpu({test::baseline_options(), test::turbo_options(), coarse}, 24);
  CHECK(rows[0].step.p999 > 0.02);  // the camera moves
  CHECK(unsteadiness(rows[1], rows[0]) <= 1.03);
  CHECK(rows[1].added.worst_p999 <= 4.0 / 255);
  CHECK(unsteadiness(rows[2], rows[0]) > 1.5);
  CHECK(rows[2].added.worst_p999 > 4.0 / 255);
  MESSAGE("added by turbo ", 255 * rows[1].added.worst_p999, "/255, x", unsteadiness(rows[1], rows[0]),
          "; by a key of 10 bits ", 255 * rows[2].added.worst_p999, "/255, x", unsteadiness(rows[2], rows[0]));
}
