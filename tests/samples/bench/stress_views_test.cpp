// stress_views_test.cpp - the fixed list of stress views: names, sizes, cameras and what they see.
// SPDX-License-Identifier: Apache-2.0
#include "stress_views.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <glm/geometric.hpp>
#include <limits>
#include <string>
#include <tuple>
#include <vector>

#include "rgs/layout.hpp"

namespace {

using namespace rgs;
using namespace rgs::bench;

// A scene of size 12 in units of `scale`, dense at (1, 2, 3), with a floater.
StressScene scene_of(double scale) {
  StressScene scene;
  scene.bulk = {scale * glm::dvec3(-4, -2, -4), scale * glm::dvec3(4, 2, 4)};
  scene.all = {scale * glm::dvec3(-400, -2, -4), scale * glm::dvec3(4, 2, 90)};
  scene.dense = scale * glm::dvec3(1, 2, 3);
  return scene;
}

// Cameras around the box, none of them along an axis.
std::vector<Camera> cameras_of(int n) {
  std::vector<Camera> cameras = orbit({{-4, -2, -4}, {4, 2, 4}}, n, {.width = 1280, .height = 960});
  for (std::size_t k = 0; k < cameras.size(); ++k) cameras[k].name = std::to_string(k);
  return cameras;
}

const StressView& find(const std::vector<StressView>& views, const std::string& name, int width, int height) {
  for (const StressView& v : views) {
    if (v.name == name && v.width == width && v.height == height) return v;
  }
  FAIL("there is no view " << name << " at " << width << "x" << height);
  return views.front();
}

glm::dvec3 seen(const Camera& camera, const glm::dvec3& p) {
  return glm::dvec3(camera.world_to_camera * glm::dvec4(p, 1));
}
// Largest difference of two positions or matrices.
double distance(const glm::dmat4& a, const glm::dmat4& b) {
  double sum = 0;
  for (int k = 0; k < 4; ++k) sum += glm::distance(a[k], b[k]);
  return sum;
}

}  // namespace

TEST_CASE("the list of stress views is fixed") {
  const std::vector<std::tuple<std::string, int, int>> expected{
      {"ordinary", 1280, 720},
      {"ordinary", 1920, 1080},
      {"ordinary", 3840, 2160},
      {"ordinary", 7680, 4320},
      {"back 30 units", 1920, 1080},
      {"back 300 units", 1920, 1080},
      {"back 3000 units", 1920, 1080},
      {"back 1x its size", 1920, 1080},
      {"back 10x its size", 1920, 1080},
      {"back 100x its size", 1920, 1080},
      {"ordinary", 33, 31},
      {"ordinary", 1, 1},
      {"ordinary", 16, 16384},
      {"ordinary", 16384, 16},
      {"field of 170 degrees", 1920, 1080},
      {"empty", 1920, 1080},
      {"empty", 3840, 2160},
      {"in the densest part", 1920, 1080},
      {"in the densest part", 3840, 2160},
      {"before the densest part", 1920, 1080},
  };
  const auto check = [&](const std::vector<StressView>& views, std::size_t n_cameras) {
    REQUIRE(views.size() == expected.size());
    for (std::size_t k = 0; k < views.size(); ++k) {
      CAPTURE(views[k].name);
      CHECK(std::tuple(views[k].name, views[k].width, views[k].height) == expected[k]);
      CHECK(views[k].cameras.size() == n_cameras);
      for (const Camera& camera : views[k].cameras) {
        CHECK(camera.width == views[k].width);
        CHECK(camera.height == views[k].height);
        CHECK(validate(camera));
      }
    }
  };
  for (const double scale : {1.0, 1e-3, 1e5}) {
    check(stress_views(cameras_of(3), scene_of(scale)), 3);
    check(stress_views({}, scene_of(scale)), 1);
  }
  check(stress_views(cameras_of(8), scene_of(1)), 8);
  // Eight of many, all around.
  const auto views = stress_views(cameras_of(80), scene_of(1));
  check(views, 8);
  CHECK(views.front().cameras.front().name == "0");
  CHECK(views.front().cameras.back().name == "70");
}

TEST_CASE("each stress view's camera matches its name") {
  const StressScene scene = scene_of(1);
  const auto cameras = cameras_of(3);
  const auto views = stress_views(cameras, scene);
  CHECK(scene.size() == doctest::Approx(12));
  for (std::size_t k = 0; k < cameras.size(); ++k) {
    CAPTURE(k);
    const Camera& from = cameras[k];
    const auto at = [&](const std::string& name, int width = 1920, int height = 1080) -> const Camera& {
      return find(views, name, width, height).cameras[k];
    };
    for (const auto& [width, height] :
         {std::pair(1280, 720), {7680, 4320}, {33, 31}, {1, 1}, {16, 16384}, {16384, 16}}) {
      const Camera& c = at("ordinary", width, height);
      CHECK(distance(c.world_to_camera, from.world_to_camera) == 0);
      CHECK(c.fx / width == doctest::Approx(from.fx / from.width));  // the horizontal field of view is kept
      CHECK(c.fx == c.fy);
      CHECK(c.cx == 0.5 * width);
      CHECK(c.cy == 0.5 * height);
    }
    // Straight back: the centre of the image stays.
    for (const auto& [label, by] : {std::pair("back 30 units", 30.0),
                                    {"back 300 units", 300.0},
                                    {"back 3000 units", 3000.0},
                                    {"back 1x its size", 12.0},
                                    {"back 10x its size", 120.0},
                                    {"back 100x its size", 1200.0}}) {
      const std::string name = label;
      CAPTURE(name);
      const glm::dvec3 moved = camera_centre(at(name)) - camera_centre(from);
      CHECK(glm::distance(moved, -by * camera_axis(from, 2)) < 1e-9 * by);
      CHECK(at(name).fx / 1920 == doctest::Approx(from.fx / from.width));
    }
    const Camera& wide = at("field of 170 degrees");
    CHECK(distance(wide.world_to_camera, from.world_to_camera) == 0);
    CHECK(std::atan2(960, wide.fx) * 360 / 3.14159265358979 == doctest::Approx(170));
    CHECK(wide.fy == wide.fx);
    // The empty views show nothing of the scene, floaters included.
    for (const int width : {1920, 3840}) {
      const Camera& empty = at("empty", width, width * 9 / 16);
      for (int corner = 0; corner < 8; ++corner) {
        const glm::dvec3 p(corner & 1 ? 4 : -400, corner & 2 ? 2 : -2, corner & 4 ? 90 : -4);
        CHECK(seen(empty, p).z <= -scene.size() * (1 - 1e-9));
      }
      CHECK(glm::distance(camera_axis(empty, 2), -camera_axis(from, 2)) < 1e-12);
    }
    CHECK(glm::length(seen(at("in the densest part"), scene.dense)) < 1e-12);
    CHECK(glm::length(seen(at("in the densest part", 3840, 2160), scene.dense)) < 1e-12);
    CHECK(glm::distance(camera_axis(at("in the densest part"), 2), camera_axis(from, 2)) < 1e-12);
    // 0.24 ahead would be too near: the near plane is at 0.2.
    CHECK(glm::distance(seen(at("before the densest part"), scene.dense), glm::dvec3(0, 0, 0.4)) < 1e-6);
  }
  const auto large = stress_views(cameras, scene_of(100));
  for (const Camera& empty : find(large, "empty", 1920, 1080).cameras) {
    CHECK(seen(empty, {-40000, 200, 9000}).z <= -1200 * (1 - 1e-9));
    CHECK(seen(empty, {400, -200, -400}).z <= -1200 * (1 - 1e-9));
  }
  CHECK(glm::distance(seen(find(large, "before the densest part", 1920, 1080).cameras[0], 100.0 * scene.dense),
                      glm::dvec3(0, 0, 24)) < 1e-9);
}

TEST_CASE("without cameras the stress views face the scene's box from the front") {
  const auto views = stress_views({}, scene_of(1));
  const Camera expected = default_view(scene_of(1).bulk, {.width = 1920, .height = 1080});
  CHECK(distance(views.front().cameras.front().world_to_camera, expected.world_to_camera) == 0);
  StressScene upside_down = scene_of(1);
  upside_down.up = -kWorldUp;
  CHECK(distance(stress_views({}, upside_down).front().cameras.front().world_to_camera, expected.world_to_camera) > 1);
}

TEST_CASE("the densest point is the middle of the closest Gaussians, in the world") {
  std::vector<float> mean;
  const auto put = [&](float x, float y, float z) { mean.insert(mean.end(), {x, y, z}); };
  for (int k = 0; k < 100; ++k) put(0.1F * static_cast<float>(k) - 5, 0, static_cast<float>(k % 7));
  const float nan = std::numeric_limits<float>::quiet_NaN();
  for (int k = 0; k < 5; ++k) put(3.01F, 0.51F, 2.02F), put(3.03F, 0.53F, 2.04F), put(nan, 0, 0);
  for (int k = 0; k < 500; ++k) put(1000, 1000, 1000);  // outside the box
  const SceneBounds box{{-5, -1, 0}, {5, 1, 7}};
  const glm::dvec3 middle(3.02, 0.52, 2.03);
  CHECK(glm::distance(densest_point(mean, kNoOrigin, box), middle) < 1e-6);
  const glm::dvec3 away(4.2e6, -1.7e5, 9);
  const SceneBounds moved{box.low + away, box.high + away};
  CHECK(glm::distance(densest_point(mean, {4.2e6, -1.7e5, 9}, moved), middle + away) < 1e-6);
  CHECK(densest_point({}, kNoOrigin, box) == glm::dvec3(0, 0, 3.5));
  // A scene of one point, and a flat one.
  const std::vector<float> point{1, 2, 3};
  CHECK(densest_point(point, kNoOrigin, {{1, 2, 3}, {1, 2, 3}}) == glm::dvec3(1, 2, 3));
}

TEST_CASE("a file's boxes, origin and up make the stress scene") {
  Declarations d;
  d.robust = {{-1, -1, -1}, {1, 1, 1}};
  d.full = {{-9, -1, -1}, {1, 1, 5}};
  d.origin = {100, 0, 0};
  d.axes = {Axis::right, Axis::up, Axis::backward};
  const std::vector<float> mean{0.5F, 0.5F, 0.5F};
  const StressScene scene = stress_scene(d, mean, {100, 0, 0});
  CHECK(scene.bulk.low == glm::dvec3(99, -1, -1));
  CHECK(scene.all.low == glm::dvec3(91, -1, -1));
  CHECK(scene.all.high == glm::dvec3(101, 1, 5));
  CHECK(scene.dense == glm::dvec3(100.5, 0.5, 0.5));
  CHECK(scene.up == glm::dvec3(0, 1, 0));
  CHECK(scene.size() == doctest::Approx(std::sqrt(12.0)));
}

TEST_CASE("frames fill the requested time, at least one") {
  CHECK(frames_within(0.05, 0.5, 100) == 100);
  CHECK(frames_within(0.05, 1, 100) == 50);
  CHECK(frames_within(0.05, 3000, 100) == 1);
  CHECK(frames_within(std::numeric_limits<double>::infinity(), 3000, 100) == 100);
  CHECK(frames_within(0.05, 0, 100) == 100);
}
