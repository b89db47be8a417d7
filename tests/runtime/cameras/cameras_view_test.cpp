// cameras_view_test.cpp - camera values: validation, resizing, views around a box and smooth paths.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <glm/gtc/matrix_transform.hpp>
#include <limits>
#include <numbers>
#include <random>

#include "rgs/camera.hpp"
#include "rgs/layout.hpp"

using namespace rgs;

namespace {

// Image position and depth of a world point.
glm::dvec3 project(const Camera& camera, const glm::dvec3& p) {
  const glm::dvec3 c = camera.world_to_camera * glm::dvec4(p, 1);
  return {camera.fx * c.x / c.z + camera.cx, camera.fy * c.y / c.z + camera.cy, c.z};
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
  bad[8].world_to_camera[3].x = kNan;
  bad[9].world_to_camera[0].x *= 1.01;
  bad[10].world_to_camera[3].w = 2;
  bad[11].world_to_camera[0].w = 1e-9;
  for (int k = 0; k < 3; ++k) bad[12].world_to_camera[k].x *= -1;  // mirrored
  bad[13].world_to_camera = glm::dmat4(0.0);
  for (std::size_t i = 0; i < bad.size(); ++i) {
    CAPTURE(i);
    REQUIRE_FALSE(validate(bad[i]));
    CHECK(validate(bad[i]).error().code == Errc::bad_camera);
    const Camera& b = bad[i];
    const auto made = make_camera(b.world_to_camera, {b.width, b.height, b.fx, b.fy, b.cx, b.cy});
    REQUIRE_FALSE(made);
    CHECK(std::string(made.error().what) == validate(bad[i]).error().what);
  }
}

TEST_CASE("validate knows what each camera model has") {
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  Camera camera = some_camera();
  const auto refused = [&] { return !validate(camera) && validate(camera).error().code == Errc::bad_camera; };
  const auto with = [&](CameraModel model, std::size_t coefficient, double value) -> const Camera& {
    camera.model = model;
    camera.distortion = {};
    camera.distortion[coefficient] = value;
    return camera;
  };
  for (std::size_t k = 0; k < camera.distortion.size(); ++k) {
    CAPTURE(k);
    CHECK(validate(with(CameraModel::opencv, k, 0.01)));
    CHECK(validate(with(CameraModel::opencv_fisheye, k, 0.01)).has_value() == (k < 4));
    for (const auto model : {CameraModel::pinhole, CameraModel::equirectangular, CameraModel::orthographic}) {
      with(model, k, 1e-9);
      CHECK(refused());
    }
    with(CameraModel::opencv, k, kNan);
    CHECK(refused());
  }
  with(static_cast<CameraModel>(5), 0, 0);
  CHECK(refused());
  with(CameraModel::equirectangular, 0, 0);
  camera.fx = camera.fy = 640 / (2 * std::numbers::pi);
  CHECK(validate(camera));
  CHECK(validate(resized(camera, 1111, 500)));
  camera.width += 2;
  CHECK(refused());

  for (const auto model : {CameraModel::pinhole, CameraModel::opencv, CameraModel::opencv_fisheye,
                           CameraModel::equirectangular, CameraModel::orthographic})
    CHECK(find_camera_model(camera_model_name(model)) == model);
  CHECK(find_camera_model("OPENCV") == std::nullopt);
}

TEST_CASE("a camera from GLM's matrices has their motion, in OpenCV's and OpenGL's axes") {
  const glm::dvec3 eye{1, -2, -5}, target{0.5, 0, 1};
  const Camera expected = some_camera();
  const Intrinsics lens{expected.width, expected.height, expected.fx, expected.fy, expected.cx, expected.cy};
  const auto same = make_camera(expected.world_to_camera, lens);
  REQUIRE(same);
  CHECK(same->world_to_camera == expected.world_to_camera);
  CHECK(same->width == 640);
  CHECK(same->height == 480);
  CHECK((same->fx == lens.fx && same->fy == lens.fy && same->cx == 320 && same->cy == 240));

  const auto from_view = make_camera(glm::lookAt(eye, target, kWorldUp), lens, CameraAxes::opengl);
  const auto from_floats =
      make_camera(glm::lookAt(glm::vec3(eye), glm::vec3(target), glm::vec3(kWorldUp)), lens, CameraAxes::opengl);
  REQUIRE(from_view);
  REQUIRE(from_floats);
  for (int k = 0; k < 4; ++k) {
    CHECK(glm::distance(from_view->world_to_camera[k], expected.world_to_camera[k]) < 1e-14);
    CHECK(glm::distance(from_floats->world_to_camera[k], expected.world_to_camera[k]) < 2e-6);
  }
  CHECK_FALSE(make_camera(glm::scale(expected.world_to_camera, glm::dvec3(1.01)), lens));
  CHECK_FALSE(make_camera(glm::transpose(expected.world_to_camera), lens));  // rows mistaken for columns
  CHECK_FALSE(make_camera(glm::perspective(1.0, 1.5, 0.1, 100.0), lens));
}

TEST_CASE("matrices go by rows and back") {
  std::array<double, 16> rows;
  for (std::size_t i = 0; i < 16; ++i) rows[i] = static_cast<double>(i);
  const glm::dmat4 matrix = from_row_major(rows);
  for (int row = 0; row < 4; ++row)
    for (int column = 0; column < 4; ++column) CHECK(matrix[column][row] == 4 * row + column);
  CHECK(row_major(matrix) == rows);
}

TEST_CASE("points are the coordinates themselves") {
  const std::vector<float> mean{1, 2, 3, 4, 5, 6, 7};
  const auto points = as_points(mean);
  REQUIRE(points.size() == 2);
  CHECK(static_cast<const void*>(points.data()) == mean.data());
  CHECK(points[0] == glm::vec3(1, 2, 3));
  CHECK(points[1] == glm::vec3(4, 5, 6));
  CHECK(as_points({}).empty());
}

TEST_CASE("up and bounds are the file's declarations") {
  Declarations declared;
  declared.robust = {{-1, -2, -3}, {4, 5, 6}};
  CHECK(declared_bounds(declared).low == glm::dvec3(-1, -2, -3));
  CHECK(declared_bounds(declared).high == glm::dvec3(4, 5, 6));
  CHECK(declared_up(declared) == glm::dvec3(0, -1, 0));
  declared.axes = {Axis::right, Axis::forward, Axis::up};
  CHECK(declared_up(declared) == glm::dvec3(0, 0, 1));
  declared.axes = {Axis::undeclared, Axis::undeclared, Axis::undeclared};
  CHECK(declared_up(declared) == kWorldUp);
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
    const glm::dvec3 eye{coordinate(generator), coordinate(generator), coordinate(generator)};
    const glm::dvec3 target{coordinate(generator), coordinate(generator), coordinate(generator)};
    const glm::dvec3 up{coordinate(generator), coordinate(generator), coordinate(generator)};
    const Camera camera = look_at(eye, target, up, {640, 480, 75});
    REQUIRE(validate(camera));
    CHECK(glm::distance(camera_centre(camera), eye) < 1e-12);
    const glm::dvec3 middle = project(camera, target);
    CHECK(middle[0] == doctest::Approx(320));
    CHECK(middle[1] == doctest::Approx(240));
    CHECK(middle[2] == doctest::Approx(glm::distance(eye, target)));
    CHECK(glm::dot(camera_axis(camera, 1), up) < 0);  // image down is opposite to up
    CHECK(std::abs(glm::dot(camera_axis(camera, 0), up)) < 1e-9);
    CHECK(2 * std::atan(320 / camera.fx) * 180 / std::numbers::pi == doctest::Approx(75));
  }
  CHECK(validate(look_at({0, 0, 0}, {0, 5, 0}, {0, -1, 0})));  // up along the line of sight
  CHECK(validate(look_at({1, 1, 1}, {1, 1, 1}, {0, 0, 0})));
}

TEST_CASE("boxes of means lie at the scene's origin") {
  const Origin origin{4.2e6 + 0.1, 0, -1};
  CHECK(placed({{1, 2, 3}, {4, 5, 6}}, origin).low == glm::dvec3(4.2e6 + 0.1 + 1, 2, 2));
  CHECK(placed({{1, 2, 3}, {4, 5, 6}}, origin).high == glm::dvec3(4.2e6 + 0.1 + 4, 5, 5));
  Declarations declared;
  declared.robust = {{-1, -2, -3}, {4, 5, 6}};
  declared.origin = origin;
  CHECK(declared_bounds(declared).low == glm::dvec3(4.2e6 + 0.1 - 1, -2, -4));
  CHECK(declared_bounds(declared).high == glm::dvec3(4.2e6 + 0.1 + 4, 5, 5));
}

TEST_CASE("a camera's centre follows from its matrix, also far away with a rotation of five decimals") {
  Camera camera = look_at({4.2e6 + 3, 1.7e5 - 2, 4.8e6 + 1}, {4.2e6, 1.7e5, 4.8e6}, kWorldUp);
  CHECK(glm::distance(camera_centre(camera), {4.2e6 + 3, 1.7e5 - 2, 4.8e6 + 1}) < 1e-8);
  for (int column = 0; column < 3; ++column) {
    for (int row = 0; row < 3; ++row) {
      double& x = camera.world_to_camera[column][row];
      x = std::round(x * 1e5) / 1e5;
    }
  }
  camera.world_to_camera[3] = glm::dvec4(-(glm::dmat3(camera.world_to_camera) * glm::dvec3(4.2e6, 1.7e5, 4.8e6)), 1);
  REQUIRE(validate(camera));
  CHECK(glm::distance(camera_centre(camera), {4.2e6, 1.7e5, 4.8e6}) < 1e-7);
}

TEST_CASE("default view and orbit see the ellipsoid in the box from above, as near as they can") {
  for (const ViewFormat format : {ViewFormat{1280, 720, 60}, ViewFormat{300, 900, 40}}) {
    const SceneBounds box{{-3, -1, 4}, {2, 1, 9}};
    for (const glm::dvec3& up : {kWorldUp, glm::dvec3{0, 0, 2}, glm::dvec3{1, 1, 0}}) {
      const auto cameras = orbit(box, 7, format, up);
      REQUIRE(cameras.size() == 7);
      CHECK(cameras[0].world_to_camera == default_view(box, format, up).world_to_camera);
      for (const Camera& camera : cameras) {
        REQUIRE(validate(camera));
        const glm::dvec3 middle = 0.5 * (box.low + box.high), half = 0.5 * (box.high - box.low);
        double widest = 0;  // share of the half picture
        for (int i = 0; i < 180 * 360; ++i) {
          const double latitude = (i / 360 - 89.5) * std::numbers::pi / 180;
          const double longitude = i % 360 * std::numbers::pi / 180;
          const glm::dvec3 direction{std::cos(latitude) * std::cos(longitude), std::sin(latitude),
                                     std::cos(latitude) * std::sin(longitude)};
          const glm::dvec3 seen = project(camera, middle + half * direction);
          REQUIRE(seen[2] > 0.2);
          widest = std::max(
              {widest, std::abs(seen[0] / (0.5 * format.width) - 1), std::abs(seen[1] / (0.5 * format.height) - 1)});
        }
        CHECK(widest < 1 + 1e-9);
        CHECK(widest > 0.999);
        CHECK(glm::dot(camera_centre(camera) - glm::dvec3(-0.5, 0, 6.5), up) > 0);
      }
    }
  }
  CHECK(validate(default_view({})));  // a scene of one point
  CHECK(orbit({}, 0).empty());
}

TEST_CASE("mean up is the cameras' common direction") {
  const auto cameras = orbit({{-1, -1, -1}, {1, 1, 1}}, 12, {}, {0, 0, 1});
  const glm::dvec3 up = mean_up(cameras);
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
    const double step = glm::distance(camera_centre(path[i]), camera_centre(path[i - 1]));
    shortest = std::min(shortest, step);
    longest = std::max(longest, step);
    CHECK(glm::dot(camera_axis(path[i], 2), camera_axis(path[i - 1], 2)) > 0.999);
  }
  CHECK(longest < 1.1 * shortest);
  for (const Camera& key : keys) {
    double nearest = 1e9;
    for (const Camera& camera : path)
      nearest = std::min(nearest, glm::distance(camera_centre(key), camera_centre(camera)));
    CHECK(nearest < longest);
  }
  const auto same_pose = [](const Camera& a, const Camera& b) {
    for (int k = 0; k < 4; ++k) CHECK(glm::distance(a.world_to_camera[k], b.world_to_camera[k]) < 1e-9);
  };
  same_pose(path.front(), keys.front());
  same_pose(path.back(), keys.back());
  CHECK(path.back().fx == doctest::Approx(keys.back().fx));
  CHECK(std::max_element(path.begin(), path.end(), [](const Camera& a, const Camera& b) { return a.fx < b.fx; })->fx >
        1.9 * keys[0].fx);
}

TEST_CASE("a path ends in its last key, whatever the number of frames") {
  std::vector<Camera> keys(2, some_camera());
  keys[1].model = CameraModel::orthographic;
  for (int tenths = 1; tenths < 20; ++tenths) {
    keys[1].world_to_camera[3].x = keys[0].world_to_camera[3].x + 0.1 * tenths;
    for (int n = 2; n < 100; ++n) {
      CAPTURE(n);
      CHECK(interpolated_path(keys, n).back().model == CameraModel::orthographic);
    }
  }
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
  CHECK(std::abs(camera_axis(turn[2], 2)[2]) < 1e-9);  // half way round, although nothing moves
}

TEST_CASE("paths interpolate what bends rays, but nothing between two models") {
  std::vector<Camera> keys{some_camera(), some_camera(), some_camera()};
  for (Camera& key : keys) key.model = CameraModel::opencv_fisheye;
  keys[0].distortion[1] = 0.1, keys[1].distortion[1] = keys[2].distortion[1] = 0.3;
  keys[1].world_to_camera[3].x += 1, keys[2].world_to_camera[3].x += 2;
  keys[2].model = CameraModel::equirectangular, keys[2].distortion = {};
  keys[2].fx = keys[2].fy = keys[2].width / 6.0;
  const auto path = interpolated_path(keys, 5);
  REQUIRE(path.size() == 5);
  for (const Camera& camera : path) CHECK(validate(camera));
  CHECK(path[1].distortion[1] == doctest::Approx(0.2));
  CHECK(path[3].model == CameraModel::opencv_fisheye);
  CHECK(path[3].fx == doctest::Approx(keys[1].fx));
  CHECK(path[3].distortion == keys[1].distortion);
  CHECK(path[4].model == CameraModel::equirectangular);
  CHECK(path[4].fx == doctest::Approx(keys[2].fx));
}

TEST_CASE("a panorama that is written with few digits stays one in all sizes") {
  Camera camera = some_camera();
  camera.model = CameraModel::equirectangular;
  camera.width = 1920, camera.height = 960;
  camera.fx = camera.fy = 305.5;  // 1920 / 2 pi is 305.577
  REQUIRE(validate(camera));
  for (const int width : {100, 7680, 65536}) CHECK(validate(resized(camera, width, width / 2)));
}
