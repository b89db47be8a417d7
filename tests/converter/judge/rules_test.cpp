// rules_test.cpp - pictures by rules: the default ones are the definition, and each cause changes some picture.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <tbb/global_control.h>

#include <set>
#include <string>
#include <vector>

#include "causes.hpp"
#include "micro_scene_fixture.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/renderer.hpp"
#include "scene_generator.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

Image by_renderer(const Scene& scene, const Camera& camera) {
  auto renderer = Renderer::create({.backend = Backend::cpu, .simd = false});
  REQUIRE(renderer);
  Image image = Image::make(camera.width, camera.height, 3);
  REQUIRE(renderer->render(scene, camera, {.rgb = image.pixels}));
  return image;
}

}  // namespace

TEST_CASE("without other rules a picture has the bits of the CPU renderer") {
  for (const Micro& micro : micro_fixtures()) {
    CAPTURE(micro.scene.name);
    for (const Camera& camera : micro.scene.cameras)
      CHECK(judge::draw(micro.defined.view().value(), camera, micro.rules()).pixels ==
            by_renderer(micro.defined, camera).pixels);
  }
}

TEST_CASE("the same of a scene with harmonics and overlaps, for any number of threads") {
  std::vector<Splat> splats(3000);
  SceneGenerator(1, splats.size(), 3).generate(0, splats);
  SplatCloud cloud;
  cloud.resize(splats.size(), 3);
  for (std::size_t i = 0; i < splats.size(); ++i) cloud.set(i, splats[i]);
  const auto scene = Scene::load(cloud);
  const auto cameras = parse_camera_json(scene_cameras_json(96, 54));
  REQUIRE(scene);
  REQUIRE(cameras);
  const Camera camera = cameras->cameras[0];
  const Image defined = by_renderer(*scene, camera);
  for (const std::size_t threads : {1U, 3U}) {
    const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
    CHECK(judge::draw(scene->view().value(), camera, {}).pixels == defined.pixels);
  }
}

TEST_CASE("each cause changes the picture of a small scene") {
  auto micros = micro_fixtures();
  // Larger than any limit of a radius, and two depths that 16 bits of the range to a third do not tell apart.
  MicroScene large = micros.front().scene;
  large.gaussians.resize(3, large.gaussians.front());
  for (float& scale : large.gaussians[0].log_scale) scale = 3.5F;
  for (float& sh : large.gaussians[0].sh) sh = -1;
  large.gaussians[0].mean[2] = 2.00001F, large.gaussians[1].mean[2] = 2, large.gaussians[2].mean[2] = 1000;
  micros.emplace_back(std::move(large));
  std::string hidden;
  for (const judge::Cause& cause : judge::all_causes()) {
    bool is_seen = false;
    for (const Micro& micro : micros) {
      judge::Rules before = micro.rules();
      // What rounds down needs steps to round to.
      if (cause.key == "8-bit-down") before.opacity_steps = 255;
      judge::Rules rules = before;
      cause.apply(rules);
      const auto other = micro.shown(rules), defined = micro.shown(before);
      for (std::size_t i = 0; i < other.size(); ++i)
        is_seen = is_seen || other[i].picture.pixels != defined[i].picture.pixels;
    }
    if (!is_seen) hidden += std::string(cause.key) + " ";
  }
  CHECK(hidden.empty());
}

TEST_CASE("keys are unique, and clients have only causes that there are") {
  std::set<std::string_view> keys;
  for (const judge::Cause& cause : judge::all_causes()) CHECK(keys.insert(cause.key).second);
  for (const judge::Client& client : judge::clients()) {
    CHECK(judge::find_client(client.key) == &client);
    for (const std::string_view key : client.causes) {
      CAPTURE(std::string(key));
      CHECK(judge::find_cause(key) != nullptr);
    }
  }
  CHECK(judge::find_cause("none") == nullptr);
}
