// devices_test.cpp - renderers of several devices: the pictures of one, and its errors.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <fstream>
#include <string>
#include <vector>

#include "device_fixture.hpp"
#include "streamed_fixture.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

int count_devices() {
  int n = 0;
  require_cuda(cudaGetDeviceCount(&n));
  return n;
}
int current_device() {
  int device = -1;
  require_cuda(cudaGetDevice(&device));
  return device;
}

/// With one device, renderers that share it.
std::vector<std::vector<int>> device_lists() {
  return {{count_devices() - 1}, {count_devices() - 1, 0}, {0, 0, 0}};
}

Renderer renderer_on(const std::vector<int>& devices) {
  auto renderer = Renderer::create({.devices = devices});
  require_ok(renderer);
  CHECK(renderer->backend() == Backend::cuda);
  return *std::move(renderer);
}

std::string write_file(const TemporaryFolder& folder, const char* name, const Bytes& bytes) {
  std::string path = folder.file(name);
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  return path;
}

Bytes file_of(const SplatCloud& cloud, Profile profile = Profile::direct) {
  EncodeOptions options;
  options.profile = profile;
  auto bytes = encode(cloud.view(), options);
  require_ok(bytes);
  return *std::move(bytes);
}

/// Pictures of cameras of one size.
struct Pictures {
  std::vector<float> rgb, alpha, depth;
  std::vector<std::uint8_t> codes;
  std::vector<FrameStats> stats;

  Pictures(Renderer& renderer, const Scene& scene, std::span<const Camera> cameras, const RenderOptions& options) {
    const std::size_t n =
        cameras.size() * static_cast<std::size_t>(cameras[0].width) * static_cast<std::size_t>(cameras[0].height);
    rgb.assign(3 * n, -1), alpha.assign(n, -1), depth.assign(n, -1), codes.assign(3 * n, 77);
    PictureArrays arrays{.rgb = rgb.data(), .codes = codes.data(), .alpha = alpha.data(), .depth = depth.data()};
    if (options.pipeline == Pipeline::turbo) arrays.depth = nullptr;  // for which it leaves its tensor cores
    auto drawn = renderer.render_all(scene, cameras, arrays, options);
    require_ok(drawn);
    stats = *std::move(drawn);
  }
};

void check_same(const Pictures& a, const Pictures& b) {
  CHECK(a.rgb == b.rgb);
  CHECK(a.alpha == b.alpha);
  CHECK(a.depth == b.depth);
  CHECK(a.codes == b.codes);
  REQUIRE(a.stats.size() == b.stats.size());
  for (std::size_t i = 0; i < a.stats.size(); ++i) {
    CAPTURE(i);
    CHECK(a.stats[i].gaussians == b.stats[i].gaussians);
    CHECK(a.stats[i].pages == b.stats[i].pages);
    CHECK(a.stats[i].detail_px == b.stats[i].detail_px);
    CHECK(a.stats[i].visible == b.stats[i].visible);
    CHECK(a.stats[i].instances == b.stats[i].instances);
    CHECK(a.stats[i].depth_bits == b.stats[i].depth_bits);
    CHECK(a.stats[i].depth_resolution == b.stats[i].depth_resolution);
  }
}

}  // namespace

TEST_CASE("several devices draw the pictures of one, byte for byte") {
  if (!device_answers()) return;
  if (race_sizes()) return skip("RGS_TEST_SIZE is race");
  const int n = small_sizes() ? 2000 : 20000, before = current_device();
  const TemporaryFolder folder;
  const SplatCloud cloud = cloud_of(random_splats(701, n), 2);
  const auto plain = Scene::load(write_file(folder, "plain.rgs", file_of(cloud)));
  const auto levels = Scene::load(write_file(folder, "levels.rgs", town({.n = n})));
  require_ok(plain);
  require_ok(levels);
  std::vector<Camera> around(7, front_camera(61, 47));
  for (std::size_t i = 0; i < around.size(); ++i) around[i].fx *= 0.5 + static_cast<double>(i);
  const std::vector<Camera> over = town_cameras(702, 7);
  Renderer one = renderer_on({});
  std::vector<Renderer> several;
  for (const std::vector<int>& devices : device_lists()) several.push_back(renderer_on(devices));
  for (const Scene& scene : {scene_of(cloud), *plain, *levels}) {
    for (const RenderOptions& options : {turbo_options(), paper_options(), baseline_options()}) {
      for (const std::size_t n_cameras : {1U, 2U, 7U}) {
        CAPTURE(n_cameras);
        const auto cameras = std::span(scene.levels() != nullptr ? over : around).first(n_cameras);
        const Pictures expected(one, scene, cameras, options);
        for (Renderer& renderer : several) {
          check_same(Pictures(renderer, scene, cameras, options), expected);
          CHECK(current_device() == before);
        }
      }
    }
  }
}

TEST_CASE("several devices tell one error, and draw on") {
  if (!device_answers()) return;
  const int before = current_device();
  const TemporaryFolder folder;
  Bytes bytes = file_of(cloud_of(random_splats(703, small_sizes() ? 300 : 20000), 3), Profile::packed);
  const auto good = Scene::load(bytes);
  require_ok(good);
  bytes[bytes.size() - 100] ^= std::byte{1};
  const std::string path = write_file(folder, "damaged.rgs", bytes);
  const std::vector<Camera> cameras(3, front_camera(61, 47));
  for (const std::vector<int>& devices : device_lists()) {
    Renderer renderer = renderer_on(devices);
    const auto damaged = Scene::open(path);
    require_ok(damaged);
    const Status prepared = renderer.prepare(*damaged);
    REQUIRE_FALSE(prepared);
    CHECK(prepared.error().code == Errc::checksum_mismatch);
    std::vector<float> rgb(cameras.size() * 3 * 61 * 47);
    const auto drawn = renderer.render_all(*damaged, cameras, {.rgb = rgb.data()});
    REQUIRE_FALSE(drawn);
    CHECK(drawn.error().code == Errc::checksum_mismatch);
    RenderOptions wrong;
    wrong.sh_degree_limit = 4;
    CHECK(renderer.render_all(*good, cameras, {.rgb = rgb.data()}, wrong).error().code == Errc::bad_argument);
    CHECK(renderer.render_all(*good, cameras, {.rgb = rgb.data()}));
    CHECK(current_device() == before);
  }
}

TEST_CASE("devices that are not there are refused, and several for pictures in a device's memory") {
  if (!device_answers()) return;
  const int n_devices = count_devices();
  for (const std::vector<int>& devices : {std::vector{n_devices}, std::vector{0, n_devices}}) {
    const auto refused = Renderer::create({.backend = Backend::cuda, .devices = devices});
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::bad_argument);
    CHECK(refused.error().found == static_cast<std::uint64_t>(n_devices));
  }
  const std::vector<Camera> cameras(2, front_camera(20, 10));
  for (const std::vector<int>& devices : device_lists()) {
    Renderer renderer = renderer_on(devices);
    const auto block = renderer.allocate_on_device(2 * 3 * 20 * 10);
    require_ok(block);
    CHECK(block->device == devices.front());
    const auto drawn = renderer.render_all(Scene(), cameras,
                                           {.codes = static_cast<std::uint8_t*>(block->data.get()), .on_device = true});
    if (devices.size() == 1) {
      CHECK(drawn);
    } else {
      REQUIRE_FALSE(drawn);
      CHECK(drawn.error().code == Errc::bad_argument);
    }
  }
}
