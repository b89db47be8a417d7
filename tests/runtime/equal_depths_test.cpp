// equal_depths_test.cpp - Gaussians of equal depth are drawn in the order of the scene, equal means of a file in that of
// its source.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

#include "grid_scene.hpp"
#include "rgs/encode.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

Scene load(std::vector<std::byte> bytes) {
  auto scene = Scene::load(std::move(bytes));
  REQUIRE(scene);
  return *std::move(scene);
}

std::vector<std::byte> file_of(const SplatCloud& cloud, Profile profile) {
  EncodeOptions options;
  options.profile = profile;
  auto bytes = encode(cloud.view(), options);
  REQUIRE(bytes);
  return *std::move(bytes);
}

}  // namespace

TEST_CASE("a scene on a grid is drawn in the source's order, as arrays and as a file in Morton order") {
  const Camera camera = turned_camera(200, 140);
  const auto splats = grid_splats(1411, 6000);
  const SplatCloud source = cloud_of(splats, 3);
  const Scene arrays = scene_of(source), in_order = scene_of(cloud_of(untied(splats, camera), 3)),
              direct = load(file_of(source, Profile::direct)), packed = load(file_of(source, Profile::packed));
  RenderOptions unordered = paper_options();
  unordered.paper.deterministic = false;
  for (const RenderOptions& options :
       {RenderOptions(), baseline_options(), unordered, turbo_options(), RenderOptions(Arithmetic())}) {
    CAPTURE(static_cast<int>(options.pipeline));
    RenderOptions exact = options;
    exact.paper.depth_order = math::DepthOrder::exact;
    for (const bool simd : {false, true}) {
      const Frame expected = render(in_order, camera, exact, {.simd = simd});
      CHECK(expected.stats.visible > 3000);
      const auto quality = [&](const Scene& scene) {
        return psnr(render(scene, camera, exact, {.simd = simd}).rgb, expected.rgb);
      };
      CHECK(quality(arrays) > 80);
      CHECK(quality(direct) > 60);
      CHECK(quality(packed) > 60);
    }
  }
}

TEST_CASE("a bin of quantised depth is drawn in the order of the scene") {
  // One bin: all depths are equal.
  const Arithmetic one_bin{.depth_order = math::DepthOrder::quantized, .depth_bits = 1, .depth_range = {100, 200}};
  const Camera camera = front_camera(64, 48);
  auto splats = grid_splats(1414, 500);
  const Frame tied = render(scene_of(cloud_of(splats)), camera, one_bin);
  // The same ellipses, each Gaussian a little farther away than the one before it.
  double distance = 1;
  for (Splat& s : splats) {
    const double scale = distance / s.mean[2];
    for (int axis = 0; axis < 3; ++axis) {
      s.mean[axis] = static_cast<float>(s.mean[axis] * scale);
      s.log_scale[axis] += static_cast<float>(std::log(scale));
    }
    distance += 0.001;
  }
  CHECK(psnr(tied.rgb, render(scene_of(cloud_of(splats)), camera, Arithmetic()).rgb) > 80);
}
