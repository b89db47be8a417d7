// cameras_view_test.cpp - camera values: validation, resizing, views around a box and smooth paths.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <random>

#include "rgs/camera.hpp"

using namespace rgs;

namespace {

double distance(const Vec3& a, const Vec3& b) {
  return std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}
double dot(const Vec3& a, const Vec3& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Image position and depth of a world point.
Vec3 project(const Camera& camera, const Vec3& p) {
  const auto& m = camera.world_to_camera;
  Vec3 c{};
  for (std::size_t r = 0; r < 3; ++r) c[r] = m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3];
  return {camera.fx * c[0] / c[2] + camera.cx, camera.fy * c[1] / c[2] + camera.cy, c[2]};
}

Camera some_camera() {
  return look_at({1, -2, -5}, {0.5, 0, 1}, kWorldUp, {640, 480, 60});
}

}  // namespace

TEST_CASE("validate accepts a view and names what is wrong with every damaged one") {
  CHECK(validate(some_camera()));
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInf = std::numeric_limits<double>::infinity();
  std::vector<Camera> bad(14, some_camera());
  bad[0].width = 0;
  bad[1].height = -1;
  bad[2].width = kMaxImageSide + 1;
  bad[3].fx = 0;
  bad[4].fy = kNan;
  bad[5].fx = kInf;
  bad[6].cx = kNan;
  bad[7].cy = kInf;
  bad[8].world_to_camera[3] = kNan;
  bad[9].world_to_camera[0] *= 1.01;
  bad[10].world_to_camera[15] = 2;
  bad[11].world_to_camera[12] = 1e-9;
  for (std::size_t i = 0; i < 3; ++i) bad[12].world_to_camera[i] *= -1;  // mirrored
  bad[13].world_to_camera = {};
  for (std::size_t i = 0; i < bad.size(); ++i) {
    CAPTURE(i);
    REQUIRE_FALSE(validate(bad[i]));
    CHECK(validate(bad[i]).error().code == Errc::bad_camera);
  }
}

TEST_CASE("resizing keeps the horizontal field of view and centres") {
  const Camera from = some_camera(), to = resized(from, 1920, 1080);
  CHECK(to.cx == 960);
  CHECK(to.cy == 540);
  CHECK(to.fx / to.width == doctest::Approx(from.fx / from.width).epsilon(1e-15));
  CHECK(to.fx == to.fy);
  Camera shifted = from;
  shifted.cx += 10;
  CHECK(resized(shifted, 1280, 960).cx == 660);
  const Camera same = resized(shifted, 640, 480);
  CHECK(same.cx == shifted.cx);
  CHECK(same.fx == shifted.fx);
}

TEST_CASE("look_at puts the target in the middle and up above it") {
  std::mt19937 generator(7);
  std::uniform_real_distribution<double> coordinate(-5, 5);
  for (int i = 0; i < 200; ++i) {
    const Vec3 eye{coordinate(generator), coordinate(generator), coordinate(generator)};
    const Vec3 target{coordinate(generator), coordinate(generator), coordinate(generator)};
    const Vec3 up{coordinate(generator), coordinate(generator), coordinate(generator)};
    const Camera camera = look_at(eye, target, up, {640, 480, 75});
    REQUIRE(validate(camera));
    CHECK(distance(camera_centre(camera), eye) < 1e-12);
    const Vec3 middle = project(camera, target);
    CHECK(middle[0] == doctest::Approx(320));
    CHECK(middle[1] == doctest::Approx(240));
    CHECK(middle[2] == doctest::Approx(distance(eye, target)));
    CHECK(dot(camera_axis(camera, 1), up) < 0);  // image down is against up
    CHECK(std::abs(dot(camera_axis(camera, 0), up)) < 1e-9);
    CHECK(2 * std::atan(320 / camera.fx) * 180 / std::numbers::pi == doctest::Approx(75));
  }
  CHECK(validate(look_at({0, 0, 0}, {0, 5, 0}, {0, -1, 0})));  // up along the line of sight
  CHECK(validate(look_at({1, 1, 1}, {1, 1, 1}, {0, 0, 0})));
}

TEST_CASE("robust bounds ignore floaters and non-finite points") {
  std::mt19937 generator(3);
  std::uniform_real_distribution<float> coordinate(-1, 1);
  std::vector<float> mean;
  for (int i = 0; i < 3000; ++i) mean.push_back(coordinate(generator) + (i % 3 == 0 ? 10.F : 0.F));
  for (int i = 0; i < 10; ++i) mean.insert(mean.end(), {1e6F, -1e6F, 1e6F});
  for (int i = 0; i < 500; ++i) mean.insert(mean.end(), {std::numeric_limits<float>::quiet_NaN(), 0, 0});
  const SceneBounds bounds = robust_bounds(mean);
  CHECK(bounds.low[0] == doctest::Approx(9.04).epsilon(0.01));
  CHECK(bounds.high[0] == doctest::Approx(10.97).epsilon(0.01));
  CHECK(bounds.high[2] < 1);
  CHECK(bounds.low[1] > -1);
  const SceneBounds none = robust_bounds({});
  CHECK(none.low[0] == -0.5);
  CHECK(none.high[2] == 0.5);
  const std::vector<float> one{1, 2, 3};
  CHECK(robust_bounds(one).low[1] == 2);
  CHECK(robust_bounds(one).high[1] == 2);
}

TEST_CASE("default view and orbit see all corners of the box from above") {
  for (const ViewFormat format : {ViewFormat{1280, 720, 60}, ViewFormat{300, 900, 40}}) {
    const SceneBounds box{{-3, -1, 4}, {2, 1, 9}};
    for (const Vec3& up : {kWorldUp, Vec3{0, 0, 2}, Vec3{1, 1, 0}}) {
      const auto cameras = orbit(box, 7, format, up);
      REQUIRE(cameras.size() == 7);
      CHECK(cameras[0].world_to_camera == default_view(box, format, up).world_to_camera);
      for (const Camera& camera : cameras) {
        REQUIRE(validate(camera));
        for (std::size_t corner = 0; corner < 8; ++corner) {
          Vec3 p{};
          for (std::size_t axis = 0; axis < 3; ++axis)
            p[axis] = (corner >> axis & 1) != 0 ? box.high[axis] : box.low[axis];
          const Vec3 seen = project(camera, p);
          CHECK(seen[2] > 0);
          CHECK(seen[0] > 0);
          CHECK(seen[0] < format.width);
          CHECK(seen[1] > 0);
          CHECK(seen[1] < format.height);
        }
        const Vec3 centre = camera_centre(camera), middle{-0.5, 0, 6.5};
        CHECK(dot({centre[0] - middle[0], centre[1] - middle[1], centre[2] - middle[2]}, up) > 0);
      }
    }
  }
  CHECK(validate(default_view({})));  // a scene of one point
  CHECK(orbit({}, 0).empty());
}

TEST_CASE("mean up is the direction that the cameras agree on") {
  const auto cameras = orbit({{-1, -1, -1}, {1, 1, 1}}, 12, {}, {0, 0, 1});
  const Vec3 up = mean_up(cameras);
  CHECK(up[2] == doctest::Approx(1));
  CHECK(mean_up({}) == kWorldUp);
}

TEST_CASE("a path goes through its keys, is smooth, evenly timed and made of valid cameras") {
  std::vector<Camera> keys = orbit({{-1, -1, -1}, {1, 1, 1}}, 9, {640, 480, 60});
  keys[4].fx *= 2;
  const auto path = interpolated_path(keys, 400);
  REQUIRE(path.size() == 400);
  double shortest = 1e9, longest = 0;
  for (std::size_t i = 0; i < path.size(); ++i) {
    REQUIRE(validate(path[i]));
    if (i == 0) continue;
    const double step = distance(camera_centre(path[i]), camera_centre(path[i - 1]));
    shortest = std::min(shortest, step);
    longest = std::max(longest, step);
    CHECK(dot(camera_axis(path[i], 2), camera_axis(path[i - 1], 2)) > 0.999);
  }
  CHECK(longest < 1.1 * shortest);
  for (const Camera& key : keys) {
    double nearest = 1e9;
    for (const Camera& camera : path) nearest = std::min(nearest, distance(camera_centre(key), camera_centre(camera)));
    CHECK(nearest < longest);
  }
  const auto same_pose = [](const Camera& a, const Camera& b) {
    for (std::size_t i = 0; i < 16; ++i)
      CHECK(a.world_to_camera[i] == doctest::Approx(b.world_to_camera[i]).epsilon(1e-9));
  };
  same_pose(path.front(), keys.front());
  same_pose(path.back(), keys.back());
  CHECK(path.back().fx == doctest::Approx(keys.back().fx));
  CHECK(std::max_element(path.begin(), path.end(), [](const Camera& a, const Camera& b) { return a.fx < b.fx; })->fx >
        1.9 * keys[0].fx);
}

TEST_CASE("paths of one key, equal keys, opposite views and no frames") {
  const std::vector<Camera> one{some_camera()};
  CHECK(interpolated_path(one, 3).size() == 3);
  CHECK(interpolated_path(one, 3)[2].world_to_camera == one[0].world_to_camera);
  CHECK(interpolated_path({}, 3).empty());
  CHECK(interpolated_path(one, 0).empty());
  const std::vector<Camera> equal(5, some_camera());
  for (const Camera& camera : interpolated_path(equal, 7)) CHECK(validate(camera));
  const std::vector<Camera> opposite{look_at({0, 0, 0}, {0, 0, 1}, kWorldUp), look_at({0, 0, 0}, {0, 0, -1}, kWorldUp)};
  const auto turn = interpolated_path(opposite, 5);
  for (const Camera& camera : turn) REQUIRE(validate(camera));
  CHECK(std::abs(camera_axis(turn[2], 2)[2]) < 1e-9);  // half way round, although nothing moved
}
