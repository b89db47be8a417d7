// first_view_test.cpp - generated scenes of many kinds are first seen as a person would choose.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <glm/geometric.hpp>
#include <glm/gtc/quaternion.hpp>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/scene_first_view.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"
#include "trivial_levels.hpp"

using namespace rgs;

namespace {

using Vec3 = glm::dvec3;

class Builder {
 public:
  double uniform(double low, double high) { return std::uniform_real_distribution(low, high)(random_); }
  Vec3 direction() {
    std::normal_distribution<double> normal;
    return glm::normalize(Vec3(normal(random_), normal(random_), normal(random_)));
  }
  void add(const Vec3& mean, const Vec3& normal, double scale, double thickness, double opacity) {
    // Turns z to the normal.
    const glm::dquat q =
        glm::normalize(normal.z < -0.999 ? glm::dquat(0, 1, 0, 0) : glm::dquat(1 + normal.z, -normal.y, normal.x, 0));
    Splat s;
    for (int k = 0; k < 3; ++k) {
      s.mean[k] = static_cast<float>(mean[k]);
      s.log_scale[k] = static_cast<float>(std::log(k < 2 ? scale : thickness * scale));
    }
    const std::array<double, 4> wxyz{q.w, q.x, q.y, q.z};
    std::ranges::transform(wxyz, s.rotation, [](double x) { return static_cast<float>(x); });
    s.opacity_logit = static_cast<float>(std::log(opacity / (1 - opacity)));
    splats_.push_back(s);
  }
  void flat(const Vec3& mean, const Vec3& normal, double scale) { add(mean, normal, scale, 0.05, 0.95); }
  /// The six walls of a box.
  void box(const Vec3& middle, const Vec3& half, double scale, int n) {
    for (int i = 0; i < n; ++i) {
      Vec3 p(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)), normal(0);
      p[i % 3] = normal[i % 3] = i % 2 == 0 ? 1 : -1;
      flat(middle + half * p, normal, scale);
    }
  }
  /// On the plane y = 0.
  void ground(double half, double scale, int n) {
    for (int i = 0; i < n; ++i) flat({uniform(-half, half), 0, uniform(-half, half)}, {0, -1, 0}, scale);
  }
  void floaters(double radius, double scale, int n) {
    for (int i = 0; i < n; ++i) add(uniform(0.5, 1.2) * radius * direction(), {0, 0, 1}, scale, 1, 0.3);
  }
  SplatCloud cloud(const glm::dmat3& rotation = glm::dmat3(1)) const {
    const glm::dquat turn = glm::quat_cast(rotation);
    SplatCloud out;
    out.resize(splats_.size(), 0);
    for (std::uint64_t i = 0; i < splats_.size(); ++i) {
      Splat s = splats_[i];
      const Vec3 mean = rotation * Vec3(s.mean[0], s.mean[1], s.mean[2]);
      const glm::dquat q = turn * glm::dquat(s.rotation[0], s.rotation[1], s.rotation[2], s.rotation[3]);
      const std::array<double, 4> wxyz{q.w, q.x, q.y, q.z};
      for (int k = 0; k < 3; ++k) s.mean[k] = static_cast<float>(mean[k]);
      std::ranges::transform(wxyz, s.rotation, [](double x) { return static_cast<float>(x); });
      out.set(i, s);
    }
    return out;
  }
  std::vector<Splat>& splats() { return splats_; }

 private:
  std::mt19937 random_{5};
  std::vector<Splat> splats_;
};

FirstView view_of(const SplatCloud& cloud) {
  const auto scene = Scene::load(cloud);
  REQUIRE(scene);
  const auto view = first_view(*scene);
  REQUIRE(view);
  CHECK(validate(default_view(*view, kNoOrigin)));
  return *view;
}

Vec3 vec(const std::array<float, 3>& v) {
  return {v[0], v[1], v[2]};
}
// Sine of the angle by which the view looks down.
double looks_down(const FirstView& view) {
  return glm::dot(vec(view.up), glm::normalize(vec(view.position) - vec(view.pivot)));
}

// Where a point lies in the picture, in shares of its half sides; {9, 9} behind.
glm::dvec2 in_picture(const FirstView& view, const Vec3& p) {
  const Camera camera = default_view(view, kNoOrigin);
  const glm::dvec4 c = camera.world_to_camera * glm::dvec4(p, 1);
  if (!(c.z > 0)) return {9, 9};
  return {camera.fx * c.x / c.z / camera.cx, camera.fy * c.y / c.z / camera.cy};
}

Builder house_with_floaters() {
  Builder b;
  b.ground(6, 0.08, 6000);
  b.box({0, -1.5, 0}, {2, 1.5, 1.5}, 0.06, 6000);
  b.floaters(9, 0.3, 100);
  return b;
}

Builder room() {
  Builder b;
  b.box({0, 0, 0}, {3, 1.5, 2.5}, 0.05, 12000);
  b.box({1.5, 1.1, 1.2}, {0.7, 0.4, 0.5}, 0.04, 3000);
  b.box({-2, 0.6, -1.5}, {0.4, 0.9, 0.6}, 0.04, 3000);
  b.box({-1, 1.2, 1}, {0.5, 0.3, 0.4}, 0.04, 3000);
  b.floaters(6, 0.4, 100);
  return b;
}

}  // namespace

TEST_CASE("a house among floaters is seen whole, from outside and a little above") {
  const FirstView view = view_of(house_with_floaters().cloud());
  CHECK(view.kind == ViewKind::outside);
  CHECK(view.up == std::array<float, 3>{0, -1, 0});
  CHECK(looks_down(view) > 0.05);
  CHECK(looks_down(view) < 0.7);
  CHECK(view.position[1] < -0.3);  // above the ground
  for (int corner = 0; corner < 8; ++corner) {
    const glm::dvec2 at = in_picture(view, {corner & 1 ? 2 : -2, corner & 2 ? 0 : -3, corner & 4 ? 1.5 : -1.5});
    CHECK(std::abs(at.x) < 1);
    CHECK(std::abs(at.y) < 1.1);
  }
}

TEST_CASE("a room is seen from inside, and an orbit turns on the spot") {
  const FirstView view = view_of(room().cloud());
  CHECK(view.kind == ViewKind::inside);
  for (std::size_t k = 0; k < 3; ++k) CHECK(std::abs(view.position[k]) < (k == 1 ? 1.5 : k == 0 ? 3 : 2.5) - 0.2);
  CHECK(std::abs(looks_down(view)) < 0.3);
  const std::vector<Camera> cameras = orbit(view, {5, 6, 7}, 4);
  for (const Camera& camera : cameras)
    CHECK(glm::distance(camera_centre(camera), Vec3(5, 6, 7) + vec(view.position)) < 1e-6);
  CHECK(glm::dot(camera_axis(cameras[0], 2), camera_axis(cameras[2], 2)) < 0);
}

TEST_CASE("an object before a far sky is seen from within the sky") {
  Builder b;
  for (int i = 0; i < 8000; ++i) {
    const Vec3 n = b.direction();
    b.flat(n * Vec3(0.5, 0.8, 0.35), n, 0.02);
  }
  for (int i = 0; i < 2000; ++i) {
    const Vec3 n = b.direction();
    b.flat(60. * n, n, 2.5);
  }
  const FirstView view = view_of(b.cloud());
  CHECK(view.kind == ViewKind::outside);
  CHECK(glm::length(vec(view.position)) < 4);
  CHECK(glm::length(vec(view.position)) > 0.9);
  CHECK(glm::length(vec(view.pivot)) < 0.3);
}

TEST_CASE("a face that was captured from before is not seen from behind") {
  Builder b;
  while (b.splats().size() < 8000) {
    const Vec3 n = b.direction();
    if (n.z < 0.15) b.flat(n * Vec3(0.8, 1.2, 1), n, 0.03);
  }
  const FirstView view = view_of(b.cloud());
  CHECK(view.kind == ViewKind::outside);
  CHECK(view.position[2] < -1);
}

TEST_CASE("a wide ground with buildings is seen from above, at a slant, as far as it reaches") {
  Builder b;
  b.ground(100, 0.9, 12000);
  for (int i = 0; i < 20; ++i) {
    const double h = b.uniform(2, 8);
    b.box({b.uniform(-80, 80), -h, b.uniform(-80, 80)}, {b.uniform(3, 7), h, b.uniform(3, 7)}, 0.6, 400);
  }
  const FirstView view = view_of(b.cloud());
  CHECK(view.kind == ViewKind::outside);
  CHECK(view.position[1] < -30);
  CHECK(looks_down(view) > 0.2);
  CHECK(looks_down(view) < 0.8);
  CHECK(std::abs(in_picture(view, {0, 0, 0}).y) < 0.3);
}

TEST_CASE("up is found by the ground, as far as 20 degrees from the guess, and not where nothing is flat") {
  for (const double degrees : {0., 8., 20.}) {
    CAPTURE(degrees);
    const glm::dmat3 tilt(glm::mat3_cast(glm::angleAxis(glm::radians(degrees), glm::normalize(Vec3(1, 0, 0.5)))));
    const FirstView view = view_of(house_with_floaters().cloud(tilt));
    CHECK(glm::dot(vec(view.up), tilt * Vec3(0, -1, 0)) > 0.9995);
    const auto scene = Scene::load(house_with_floaters().cloud(tilt));
    CHECK(first_view(*scene, {0, -1, 0}, true)->up == std::array<float, 3>{0, -1, 0});
  }
  Builder b;
  for (int i = 0; i < 5000; ++i) b.flat(b.direction(), b.direction(), 0.05);
  CHECK(view_of(b.cloud()).up == std::array<float, 3>{0, -1, 0});
}

TEST_CASE("neither the order of the Gaussians nor an .rgs moves the view") {
  SplatCloud cloud = room().cloud();
  const FirstView view = view_of(cloud);
  SplatCloud turned = cloud;
  for (std::uint64_t i = 0; i < cloud.size(); ++i) turned.set(cloud.size() - 1 - i, cloud.view().splat(i));
  CHECK(view_of(turned) == view);
  const test::TemporaryFolder folder;
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    EncodeOptions options;
    options.profile = profile;
    const std::string path = folder.file("scene.rgs");
    const std::vector<std::byte> bytes = encode(cloud.view(), options).value();
    test::write_text(path, {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
    for (const bool loads : {false, true}) {
      const auto scene = loads ? Scene::load(path) : Scene::open(path);
      REQUIRE(scene);
      const FirstView stored = first_view(*scene).value();
      CHECK(stored.kind == view.kind);
      CHECK(glm::distance(vec(stored.position), vec(view.position)) < 0.01);
      CHECK(glm::distance(vec(stored.up), vec(view.up)) < 0.001);
    }
  }
}

TEST_CASE("a scene whose file states a view has that one, however it is opened") {
  const SplatCloud cloud = room().cloud();
  EncodeOptions options;
  options.first_view = {ViewKind::outside, {0, 1, -40}, {0, 1, 0}, {0, -1, 0}, 50};
  const test::TemporaryFolder folder;
  const std::string path = folder.file("levels.rgs");
  std::vector<std::byte> levels;
  REQUIRE(write_levels(test::trivial_levels(cloud, {.page_chunks = 4}), options, levels));
  test::write_text(path, {reinterpret_cast<const char*>(levels.data()), levels.size()});
  const auto plain = Scene::load(encode(cloud.view(), options).value());
  const auto whole = Scene::open(path), streamed = Scene::open(path, {.pool = StreamPool::create().value()});
  const auto in_memory = Scene::load(cloud, plain->declarations());
  for (const auto* scene : {&plain, &whole, &streamed, &in_memory}) {
    REQUIRE(scene->has_value());
    CHECK(first_view(**scene, {0, 0, 1}, true) == options.first_view);
  }
}

TEST_CASE("an orbit from outside goes round the pivot and begins with the first view") {
  const FirstView view = view_of(house_with_floaters().cloud());
  const std::vector<Camera> cameras = orbit(view, kNoOrigin, 5, {64, 48, 20});
  REQUIRE(cameras.size() == 5);
  CHECK(cameras[0].world_to_camera == default_view(view, kNoOrigin).world_to_camera);
  CHECK(cameras[0].fx == doctest::Approx(32 / std::tan(glm::radians(30.))));
  for (const Camera& camera : cameras) {
    const glm::dvec4 pivot = camera.world_to_camera * glm::dvec4(vec(view.pivot), 1);
    CHECK(glm::length(glm::dvec2(pivot)) < 1e-5);
    CHECK(pivot.z == doctest::Approx(glm::distance(vec(view.position), vec(view.pivot))));
    CHECK(glm::dot(camera_axis(camera, 1), vec(view.up)) < 0);
  }
  CHECK(orbit(view, kNoOrigin, 0).empty());
}

TEST_CASE("degenerate scenes have a view") {
  CHECK(view_of(SplatCloud()).kind == ViewKind::outside);
  const float infinity = std::numeric_limits<float>::infinity();
  for (const float at : {0.F, 1e-30F, 1e18F, 3e38F}) {
    for (const float log_scale : {-infinity, 0.F, 40.F}) {
      for (const int n : {1, 40}) {
        CAPTURE(at);
        CAPTURE(log_scale);
        CAPTURE(n);
        SplatCloud cloud;
        cloud.resize(static_cast<std::uint64_t>(n), 0);
        for (int i = 0; i < n; ++i) {
          Splat s;
          s.mean[i % 3] = i % 2 == 0 ? at : -at;
          std::ranges::fill(s.log_scale, log_scale);
          s.log_scale[2] = -20;
          cloud.set(static_cast<std::uint64_t>(i), s);
        }
        FirstViewSample sample;
        const auto scene = Scene::load(cloud);
        const auto arrays = scene->view();
        for (std::uint64_t i = 0; i < arrays->n; ++i)
          sample.add(&arrays->mean[3 * i], &arrays->scale[3 * i], &arrays->rotation[4 * i], arrays->opacity[i]);
        const FirstView view = choose_first_view(sample, {0, -1, 0}, true);
        if (view.kind != ViewKind::none) CHECK(validate(default_view(view, kNoOrigin)));
      }
    }
  }
  FirstViewSample bad;
  const std::array<float, 4> nan{std::nanf(""), 1, 1, 1};
  bad.add(nan.data(), nan.data(), nan.data(), 1);
  CHECK(bad.n() == 1);
  CHECK(bad.rows().empty());
  CHECK(choose_first_view(bad, {0, -1, 0}, true) == FirstView());
}
