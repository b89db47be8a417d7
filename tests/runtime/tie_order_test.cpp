// tie_order_test.cpp - Gaussians of equal depth are drawn in an order of their values, whatever the file's order.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstdint>
#include <vector>

#include "complexity.hpp"
#include "grid_scene.hpp"
#include "rgs/encode.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

std::vector<RenderOptions> every_arithmetic() {
  RenderOptions unordered = paper_options();
  unordered.paper.deterministic = false;
  return {RenderOptions(),
          baseline_options(),
          paper_options(),
          unordered,
          turbo_options(),
          Arithmetic(),
          Arithmetic{.depth_order = math::DepthOrder::quantized, .depth_bits = 3, .depth_range = {1, 6}}};
}

}  // namespace

TEST_CASE("a scene on a grid is drawn to the same bytes in any order of Gaussians") {
  const auto splats = grid_splats(1411, 6000);
  const Camera camera = front_camera(200, 140);
  for (const RenderOptions& options : every_arithmetic()) {
    CAPTURE(static_cast<int>(options.pipeline));
    CAPTURE(static_cast<int>(options.paper.depth_order));
    for (const bool simd : {false, true}) {
      const auto draw = [&](const std::vector<Splat>& of, int threads) {
        return render(scene_of(cloud_of(of, 3)), camera, options, {.threads = threads, .simd = simd});
      };
      const Frame expected = draw(splats, 1);
      CHECK(expected.stats.visible > 3000);
      for (const unsigned seed : {1u, 2u, 3u}) {
        const Frame other = draw(shuffled(splats, seed), 2);
        CHECK(other.rgb == expected.rgb);
        CHECK(other.depth == expected.depth);
        CHECK(other.blended == expected.blended);
        CHECK(other.evaluated == expected.evaluated);
      }
    }
  }
}

TEST_CASE("a file in another order than its source is drawn like one in the source's") {
  const auto splats = shuffled(grid_splats(1412, 6000), 1);
  const Camera camera = front_camera(200, 140);
  const SplatCloud cloud = cloud_of(splats, 3);
  EncodeOptions kept;
  kept.order = Order::input;
  const auto draw = [&](const EncodeOptions& how) {
    const auto bytes = encode(cloud.view(), how);
    REQUIRE(bytes);
    const auto scene = Scene::load(*bytes);
    REQUIRE(scene);
    return render(*scene, camera);
  };
  const Frame source = render(scene_of(cloud), camera);
  const double in_order = psnr(draw(kept).rgb, source.rgb), reordered = psnr(draw({}).rgb, source.rgb);
  MESSAGE("in the source's order ", in_order, " dB, reordered ", reordered, " dB");
  CHECK(in_order > 50);
  CHECK(reordered > in_order - 3);
}

TEST_CASE("growth: a scene whose depths are all equal takes time linear in its size") {
  const Camera camera = front_camera(16, 16);
  for (const bool one_place : {false, true}) {
    CAPTURE(one_place);
    const auto wall = [&](std::uint64_t n) {
      Random random(1413);
      std::vector<Splat> splats;
      for (std::uint64_t i = 0; i < n; ++i) {
        const double x = one_place ? 0 : random.uniform(-1, 1), y = one_place ? 0 : random.uniform(-1, 1);
        splats.push_back(splat_at(x, y, 5, 0.001, 0.5));
      }
      return scene_of(cloud_of(splats));
    };
    CHECK(growth(2000, wall, [&](const Scene& scene) {
            CHECK(render(scene, camera, Arithmetic(), {.threads = 1}).stats.visible == scene.size());
          }) < kLinearGrowth);
  }
}

TEST_CASE("a frame's memory for ties counts as its workspace") {
  static constexpr int kCount = 1000;  // in one tile
  const auto bytes = [](bool is_tied) {
    std::vector<Splat> splats;
    for (int i = 0; i < kCount; ++i) splats.push_back(splat_at(0, 0, 5 + 0.001 * (is_tied ? i / 2 : i), 0.001, 0.5));
    const Frame frame = render(scene_of(cloud_of(splats)), front_camera(16, 16), Arithmetic());
    CHECK(frame.stats.instances == kCount);
    return frame.stats.bytes;
  };
  CHECK(bytes(true) == bytes(false) + kCount / 2 * 16);  // begin and end of each pair
}
