// subject_bounds_test.cpp - a scene without cameras is seen from the same place, however its file stores it.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstddef>
#include <glm/geometric.hpp>
#include <random>
#include <string>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/scene.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"
#include "trivial_levels.hpp"

using namespace rgs;

namespace {

// A house-sized cuboid of 6,000 Gaussians, and as many floaters as a trained scene has: 600.
SplatCloud scene_with_floaters() {
  std::mt19937 random(7);
  std::uniform_real_distribution<float> one(-1, 1);
  std::normal_distribution<float> normal;
  SplatCloud cloud;
  cloud.resize(6600, 1);
  for (std::uint64_t i = 0; i < cloud.size(); ++i) {
    Splat s;
    const float size[3] = {3, 1, 2};
    for (std::size_t k = 0; k < 3; ++k) {
      s.mean[k] = i % 11 == 10 ? 40 * normal(random) : 2 + size[k] * one(random);
      s.log_scale[k] = -3 + one(random);
    }
    for (float& x : s.rotation) x = normal(random);
    for (float& x : s.sh) x = one(random);
    s.opacity_logit = 3 * one(random);
    cloud.set(i, s);
  }
  return cloud;
}

SceneBounds bounds_of(const Scene& scene) {
  const auto bounds = subject_bounds(scene);
  REQUIRE(bounds);
  return *bounds;
}

// Most pixels by which any corner of the box moves between the two default views of 1280 x 720.
double moved_px(const SceneBounds& a, const SceneBounds& b) {
  const Camera from = default_view(a), to = default_view(b);
  double most = 0;
  for (int corner = 0; corner < 8; ++corner) {
    const glm::dvec4 p(corner & 1 ? a.high.x : a.low.x, corner & 2 ? a.high.y : a.low.y,
                       corner & 4 ? a.high.z : a.low.z, 1);
    const glm::dvec4 at = from.world_to_camera * p, then = to.world_to_camera * p;
    most = std::max({most, from.fx * glm::distance(at.x / at.z, then.x / then.z),
                     from.fy * glm::distance(at.y / at.z, then.y / then.z)});
  }
  return most;
}

}  // namespace

TEST_CASE("the default view of a scene is that of its .rgs in every profile, with and without levels") {
  const SplatCloud cloud = scene_with_floaters();
  const Origin origin{1000, -20, 5};
  EncodeOptions options;
  options.origin = origin;
  Declarations declared;
  declared.origin = origin;
  const SceneBounds source = bounds_of(Scene::load(cloud, declared).value());
  // The subject fills the picture, whatever floats about it.
  CHECK(glm::distance(0.5 * (source.low + source.high), glm::dvec3(1002, -18, 7)) < 0.2);
  CHECK(glm::distance(source.low, source.high) < 7.5);

  const test::TemporaryFolder folder;
  const auto kept = [&](const std::vector<std::byte>& bytes, const std::string& name) {
    test::write_text(folder.file(name), {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
    return folder.file(name);
  };
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    options.profile = profile;
    // Archives round means and opacities.
    const double allowed = profile == Profile::archive ? 1.5 : 0.1;
    const auto bytes = encode(cloud.view(), options);
    REQUIRE(bytes);
    CHECK(moved_px(source, bounds_of(Scene::load(*bytes).value())) < allowed);
    CHECK(moved_px(source, bounds_of(Scene::open(kept(*bytes, "plain.rgs")).value())) < allowed);

    std::vector<std::byte> levels;
    REQUIRE(write_levels(test::trivial_levels(decode(*bytes).value(), {.page_chunks = 1}), options, levels));
    const std::string path = kept(levels, "levels.rgs");
    CHECK(moved_px(source, bounds_of(Scene::open(path).value())) < allowed);
    // Known from the table of pages alone, here of 26 leaves: within a sixth of the longest side.
    const SceneBounds streamed = bounds_of(Scene::open(path, {.pool = StreamPool::create().value()}).value());
    for (int k = 0; k < 3; ++k) {
      CHECK(std::abs(streamed.low[k] - source.low[k]) < 1);
      CHECK(std::abs(streamed.high[k] - source.high[k]) < 1);
    }
  }
}
