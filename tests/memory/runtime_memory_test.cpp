// runtime_memory_test.cpp - camera files, pictures and the CPU renderer where memory runs out.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <string_view>

#include "failing_memory.hpp"
#include "plausible_cloud.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/image_metrics.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene.hpp"

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

TEST_CASE("the CPU renderer, which draws the next frame after one that had no memory, and comparing pictures") {
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
