// runtime_memory_test.cpp - camera files, sources, pictures and the CPU renderer without memory.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <string>
#include <string_view>

#include "failing_memory.hpp"
#include "made_bytes.hpp"
#include "plausible_cloud.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/image_metrics.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene.hpp"
#include "temporary_folder.hpp"
#ifdef RGS_TEST_HTTP
#include "web_servers.hpp"
#endif

using namespace rgs;
using rgs::test::fail_each_allocation;
using rgs::test::hash_of;

TEST_CASE("COLMAP's cameras") {
  constexpr std::string_view kLenses = "1 PINHOLE 640 480 500 500 320 240\n";
  constexpr std::string_view kImages = "1 1 0 0 0 0.5 0 2 1 a name that is longer than a short string.jpg\n\n";
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto set = parse_colmap_text(kLenses, kImages);
    if (!set) return tl::unexpected(set.error());
    return hash_of(std::as_bytes(std::span(set->cameras.at(0).name)));
  });
}

namespace {

void read_source(const std::string& name, const UrlOptions& options = {}) {
  const std::int64_t n = fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto source = open_source(name, options);
    if (!source) return tl::unexpected(source.error());
    std::array<std::byte, 1000> bytes{};
    if (Status s = (*source)->read(100000, bytes); !s) return tl::unexpected(s.error());
    return hash_of(bytes);
  });
  CHECK(n >= 1);
}

}  // namespace

TEST_CASE("a file read by ranges") {
  const test::TemporaryFolder folder;
  test::write_bytes(folder.file("scene.rgs"), 200000);
  read_source(folder.file("scene.rgs"));
}

#ifdef RGS_TEST_HTTP
TEST_CASE("a file behind a web server") {
  const test::HostileServer server;
  read_source(server.url("/plain"));
  read_source(server.url("/redirect?to=/plain"));
}
#endif

TEST_CASE("the CPU renderer, which draws the next frame after one that failed, and comparing pictures") {
  test::SplitMix random{9};
  const Scene scene = Scene::load(test::plausible_cloud(300, 1, random)).value();
  Camera camera;
  camera.width = camera.height = 48;
  camera.fx = camera.fy = 40;
  camera.cx = camera.cy = 24;
  camera.world_to_camera[3].z = 12;
  Image image = Image::make(48, 48, 3);
  RenderTarget target;
  target.rgb = image.pixels;
  RendererOptions cpu;
  cpu.backend = Backend::cpu;
  const auto draw = [&](Renderer& renderer) -> Result<std::uint64_t> {
    const auto stats = renderer.render(scene, camera, target, {});
    if (!stats) return tl::unexpected(stats.error());
    return hash_of(image.pixels);
  };
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    auto renderer = Renderer::create(cpu);
    if (!renderer) return tl::unexpected(renderer.error());
    return draw(*renderer);
  });
  Renderer kept = Renderer::create(cpu).value();
  fail_each_allocation([&]() -> Result<std::uint64_t> { return draw(kept); });
  Image other = image;
  other.pixels[5] += 0.25f;
  fail_each_allocation([&]() -> Result<std::uint64_t> {
    const auto found = difference(image, other);
    if (!found) return tl::unexpected(found.error());
    const auto likeness = ssim(image, other);
    if (!likeness) return tl::unexpected(likeness.error());
    return found->largest_index + static_cast<std::uint64_t>(*likeness * 1e6);
  });
}
