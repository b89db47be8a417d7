// equal_depths_test.cpp - every pipeline draws equal depths in the order of the scene, on every run.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <vector>

#include "device_fixture.hpp"
#include "grid_scene.hpp"
#include "rgs/cuda_renderer.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

std::vector<float> draw(const Scene& scene, const Camera& camera, const RenderOptions& options) {
  return render(scene, camera, options, {.backend = Backend::cuda}).rgb;
}

struct Mode {
  const char* name;
  RenderOptions options;
};
std::vector<Mode> modes() {
  RenderOptions separate = paper_options(), turbo_fp32 = turbo_options();
  separate.paper.front_end = PaperSteps::FrontEnd::separate;
  turbo_fp32.turbo.tensor_cores = false;
  return {{"baseline", baseline_options()},
          {"paper", paper_options()},
          {"paper, separate front end", separate},
          {"paper, few bins",
           Arithmetic{.depth_order = math::DepthOrder::quantized, .depth_bits = 3, .depth_range = {1, 6}}},
          {"turbo", turbo_options()},
          {"turbo, FP32", turbo_fp32}};
}

}  // namespace

TEST_CASE("every pipeline draws equal depths in the order of the scene, on every run") {
  if (!device_answers()) return;
  auto splats = grid_splats(1422, sized(40000, 800, 200));
  splats.push_back(splat_at(0, 0, 3, 20, 0.2, 0.3F));  // of many tiles: turbo treats them as large
  splats.push_back(splat_at(0, 0, 3, 20, 0.2, 0.9F));
  const int width = sized(640, 96, 32), height = sized(360, 64, 32);
  const SplatCloud source = cloud_of(splats, 3);
  const Scene arrays = scene_of(source), shuffled_arrays = scene_of(cloud_of(shuffled(splats, 1), 3));
  const auto bytes = encode(source.view());
  require_ok(bytes);
  const auto file = Scene::load(*bytes);
  require_ok(file);
  for (const Mode& mode : modes()) {
    CAPTURE(mode.name);
    // Seen along its axis, the grid has a few depths in all; turned, only equal means tie.
    for (const Camera& camera : {front_camera(width, height), turned_camera(width, height)}) {
      const auto expected = draw(arrays, camera, mode.options);
      CHECK(draw(arrays, camera, mode.options) == expected);
      for (const Scene* scene : {&arrays, &shuffled_arrays, &*file}) {
        const Frame host = render(*scene, camera, mode.options, {.backend = Backend::cpu});
        const double quality = psnr(draw(*scene, camera, mode.options), host.rgb);
        CHECK_MESSAGE(quality >= 50, quality, " dB against the CPU");
      }
      if (!race_sizes()) CHECK(psnr(draw(shuffled_arrays, camera, mode.options), expected) < 45);
    }
    if (mode.options.paper.depth_bits != 0) continue;  // its bins hold different means
    RenderOptions exact = mode.options;
    exact.paper.depth_order = math::DepthOrder::exact;
    const Camera camera = turned_camera(width, height);
    const double quality = psnr(draw(*file, camera, exact), draw(arrays, camera, exact));
    CHECK_MESSAGE(quality >= 50, "the file in Morton order, ", quality, " dB against its source");
  }
}
