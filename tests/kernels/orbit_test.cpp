// orbit_test.cpp - a moving camera on the device: no mode pops more than baseline.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <optional>
#include <string>
#include <vector>

#include "device_fixture.hpp"
#include "orbit_motion.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/cuda_renderer.hpp"
#include "scene_generator.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// The generated scene on the device as an .rgs file, and pictures of it.
class OrbitStage {
 public:
  OrbitStage(std::uint64_t n, int width, int height)
      : camera_(parse_camera_json(scene_cameras_json(width, height))->cameras.front()),
        pixels_(3 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height)) {
    std::vector<Splat> splats(n);
    SceneGenerator(5, n, 3).generate(0, splats);
    auto uploaded = DeviceScene::upload(CompactScene::of(cloud_of(splats, 3)).file);
    require_ok(uploaded);
    scene_ = *std::move(uploaded);
    auto renderer = CudaRenderer::create();
    require_ok(renderer);
    renderer_.emplace(*std::move(renderer));
  }

  /// Rows of baseline, of turbo with and without tensor cores, and of baseline with a depth key of 10 bits, which pops.
  std::vector<bench::OrbitRow> follow(int frames) {
    RenderOptions coarse{.pipeline = Pipeline::paper, .paper = steps_of(baseline_options(), Backend::cuda)};
    coarse.paper.depth_order = math::DepthOrder::quantized;
    coarse.paper.depth_bits = 10;
    RenderOptions fp32 = turbo_options();
    fp32.turbo.tensor_cores = false;
    const RenderOptions modes[] = {baseline_options(), turbo_options(), fp32, coarse};
    const std::string names[] = {"baseline", "turbo", "turbo, FP32", "10 bits"};
    const auto path = bench::turntable(camera_, distance(), 0.25, frames);
    auto rows = bench::follow(path, names, [&](std::size_t mode, const Camera& view) -> Result<Image> {
      pixels_.fill(0xFF);
      const auto stats = renderer_->render(scene_, view, {.rgb = pixels_.data()}, modes[mode]);
      if (!stats) return tl::unexpected(stats.error());
      return Image{view.width, view.height, 3, pixels_.download()};
    });
    require_ok(rows);
    return *std::move(rows);
  }

 private:
  double distance() {
    DeviceArray<float> depth(pixels_.size() / 3);
    require_ok(renderer_->render(scene_, camera_, {.depth = depth.data()}, baseline_options()));
    return bench::look_at_distance(depth.download());
  }

  Camera camera_;
  DeviceArray<float> pixels_;
  DeviceScene scene_;
  std::optional<CudaRenderer> renderer_;
};

}  // namespace

TEST_CASE("turbo pops no more than baseline on an orbit of 60 frames; a coarse depth key does") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  OrbitStage stage = small_sizes() ? OrbitStage(20000, 240, 135) : OrbitStage(100000, 960, 540);
  const auto rows = stage.follow(small_sizes() ? 8 : 60);
  const bench::OrbitRow &baseline = rows[0], &coarse = rows[3];
  for (const bench::OrbitRow& row : rows) {
    MESSAGE(row.mode, ": step ", 255 * row.step.mean, ", ", 255 * row.step.worst_p999, ", second difference ",
            255 * row.second.mean, ", ", 255 * row.second.worst_p999, ", added ", 255 * row.added.worst_p999,
            " /255; x", bench::unsteadiness(row, baseline));
  }
  CHECK(baseline.step.p999 > 0.02);  // the camera does move
  for (const bench::OrbitRow& turbo : {rows[1], rows[2]}) {
    CAPTURE(turbo.mode);
    // Turbo rounds colours (and exponents, with tensor cores) to FP16 and continues slightly beyond baseline's stop:
    // noise of a few 1/255, which adds less than 3 % to differences of tens. A Gaussian out of order causes tens.
    CHECK(bench::unsteadiness(turbo, baseline) <= 1.03);
    CHECK(turbo.added.worst_p999 <= 4.0 / 255);
    // The same measures detect popping.
    CHECK(bench::unsteadiness(coarse, baseline) > bench::unsteadiness(turbo, baseline));
  }
  CHECK(coarse.added.worst_p999 > 4.0 / 255);
}
