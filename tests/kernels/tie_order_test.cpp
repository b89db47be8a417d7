// tie_order_test.cpp - the device's ranks equal the CPU's order, and every pipeline draws equal depths by them.
// SPDX-License-Identifier: Apache-2.0
#include "common/tie_order.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

#include "device_fixture.hpp"
#include "grid_scene.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/math/tie_order.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

struct HostValues {
  SceneView scene;

  float mean(std::uint32_t i, int axis) const { return scene.mean[3 * i + static_cast<std::uint32_t>(axis)]; }
  float opacity(std::uint32_t i) const { return scene.opacity[i]; }
  math::Vec3<float> scale(std::uint32_t i) const {
    return {scene.scale[3 * i], scene.scale[3 * i + 1], scene.scale[3 * i + 2]};
  }
  math::Quaternion<float> rotation(std::uint32_t i) const {
    return {scene.rotation[4 * i], scene.rotation[4 * i + 1], scene.rotation[4 * i + 2], scene.rotation[4 * i + 3]};
  }
  int n_sh() const { return 3 * sh_coefficients(scene.sh_degree); }
  float sh(std::uint32_t i, int k) const {
    return scene.sh[static_cast<std::uint32_t>(n_sh()) * i + static_cast<std::uint32_t>(k)];
  }
};

std::vector<std::uint32_t> host_ranks(const SceneView& scene) {
  std::vector<std::uint32_t> order(scene.n), rank(scene.n);
  std::iota(order.begin(), order.end(), 0u);
  const HostValues values{scene};
  std::sort(order.begin(), order.end(),
            [&](std::uint32_t a, std::uint32_t b) { return math::ties_before(values, a, b); });
  for (std::uint32_t k = 0; k < order.size(); ++k) rank[order[k]] = k;
  return rank;
}

std::vector<std::uint32_t> device_ranks(const DeviceAttributes& attributes, std::uint64_t n) {
  const auto count = static_cast<std::uint32_t>(n);
  const auto bytes = cuda::tie_order_bytes(count);
  require_ok(bytes);
  const DeviceArray<std::uint32_t> order(n), rank(n);
  const DeviceArray<std::byte> temporary(*bytes);
  require_ok(
      cuda::launch_tie_order({attributes.get(), count, order.data(), rank.data(), temporary.data(), *bytes}, nullptr));
  temporary.check_guards();
  const auto in_order = order.download(), ranks = rank.download();
  for (std::uint32_t k = 0; k < count; ++k) REQUIRE(ranks[in_order[k]] == k);
  return ranks;
}

DeviceScene upload(const SplatCloud& cloud) {
  auto uploaded = DeviceScene::upload(scene_of(cloud).view().value());
  require_ok(uploaded);
  return *std::move(uploaded);
}

struct Picture {
  std::vector<float> rgb, alpha;
  bool operator==(const Picture&) const = default;
};
Picture draw(const DeviceScene& scene, const Camera& camera, const RenderOptions& options) {
  auto renderer = CudaRenderer::create();
  require_ok(renderer);
  const auto n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
  const DeviceArray<float> rgb(3 * n), alpha(n);
  synchronize();
  require_ok(renderer->render(scene, camera, {.rgb = rgb.data(), .alpha = alpha.data()}, options));
  return {rgb.download(), alpha.download()};
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

TEST_CASE("the device's ranks are positions in the CPU's tie order, for FP32 and compact attributes") {
  if (!device_answers()) return;
  for (const int n : {0, 1, 2, 255, 257, sized(60000, 3000, 600)}) {
    CAPTURE(n);
    const auto splats = grid_splats(1421, n);
    for (const int degree : {0, 1, 2, 3}) {
      CAPTURE(degree);
      const SplatCloud cloud = cloud_of(splats, degree);
      const Scene scene = scene_of(cloud);
      const SceneView view = scene.view().value();
      if (n > 0) CHECK(device_ranks(DeviceAttributes(view), view.n) == host_ranks(view));
      for (const Order order : {Order::input, Order::morton}) {
        EncodeOptions encoding;
        encoding.order = order;
        const auto compact = CompactScene::of(cloud, encoding);
        const SceneView decoded = compact.scene.view().value();
        if (n > 0) CHECK(device_ranks(DeviceAttributes(compact.file), decoded.n) == host_ranks(decoded));
      }
    }
  }
  // All equal: by index.
  const SplatCloud wall = cloud_of(
      std::vector(sized(std::size_t{200000}, std::size_t{3000}, std::size_t{600}), splat_at(0, 0, 3, 0.1, 0.5)), 3);
  const auto ranks = device_ranks(DeviceAttributes(scene_of(wall).view().value()), wall.size());
  for (std::uint32_t i = 0; i < ranks.size(); ++i) REQUIRE(ranks[i] == i);
}

TEST_CASE("every pipeline draws a scene on a grid to the same bytes in any order of Gaussians") {
  if (!device_answers()) return;
  const Camera camera = front_camera(sized(640, 96, 32), sized(360, 64, 32));
  auto splats = grid_splats(1422, sized(40000, 800, 200));
  splats.push_back(splat_at(0, 0, 3, 20, 0.2, 0.3F));  // of many tiles: turbo treats them as large
  splats.push_back(splat_at(0.25, 0, 3, 20, 0.2, 0.9F));
  EncodeOptions encoding;  // values independent of neighbours
  encoding.order = Order::input;
  encoding.chunk_step_sets = false;
  for (const Mode& mode : modes()) {
    CAPTURE(mode.name);
    const Picture fp32 = draw(upload(cloud_of(splats, 3)), camera, mode.options);
    const auto file = [&](const std::vector<Splat>& of) {
      const auto compact = CompactScene::of(cloud_of(of, 3), encoding);
      auto scene = DeviceScene::upload(compact.file);
      require_ok(scene);
      return draw(*scene, camera, mode.options);
    };
    const Picture compact = file(splats);
    for (unsigned seed = 1; seed <= sized(3u, 3u, 1u); ++seed) {
      const auto other = shuffled(splats, seed);
      CHECK(draw(upload(cloud_of(other, 3)), camera, mode.options) == fp32);
      CHECK(file(other) == compact);
    }
    const Frame host = render(scene_of(cloud_of(splats, 3)), camera, mode.options, {.backend = Backend::cpu});
    const double quality = psnr(fp32.rgb, host.rgb);
    CHECK_MESSAGE(quality >= 50, quality, " dB against the CPU");
  }
}

TEST_CASE("frames of several scenes in one renderer each use their own scene's order") {
  if (!device_answers()) return;
  const Camera camera = front_camera(96, 64);
  const auto splats = grid_splats(1423, sized(3000, 3000, 300));
  const DeviceScene first = upload(cloud_of(splats, 1)), second = upload(cloud_of(shuffled(splats, 1), 1)),
                    part = upload(cloud_of(std::span(splats).first(splats.size() / 4), 1));
  for (const Mode& mode : modes()) {
    CAPTURE(mode.name);
    auto renderer = CudaRenderer::create();
    require_ok(renderer);
    const DeviceArray<float> rgb(3 * 96 * 64);
    const auto next = [&](const DeviceScene& scene) {
      rgb.check_guards();
      synchronize();
      require_ok(renderer->render(scene, camera, {.rgb = rgb.data()}, mode.options));
      return rgb.download();
    };
    const auto expected = next(first), of_part = draw(part, camera, mode.options).rgb;
    CHECK(next(second) == expected);
    CHECK(next(part) == of_part);
    CHECK(next(first) == expected);
    CHECK(next(part) == of_part);
  }
}
