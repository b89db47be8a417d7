// levels_test.cpp - scenes with levels of detail: the pages that a view draws, and unchanged leaves.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "renderer_fixture.hpp"
#include "rgs/encode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "scene_of_pages.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

struct Files {
  std::vector<std::byte> plain, levels;
};

/// 3,000 Gaussians in the order of the file without levels, and with levels: pages of two chunks of 32.
Files files(Profile profile = Profile::direct, bool keep_permutation = false) {
  EncodeOptions options;
  options.chunk_size = 32;
  options.profile = profile;
  Files files;
  const auto plain = encode(cloud_of(random_splats(1901, 3000), 1).view(), options);
  REQUIRE(plain);
  files.plain = *plain;
  auto cloud = decode(files.plain);
  REQUIRE(cloud);
  options.order = Order::morton;
  options.keep_permutation = keep_permutation;
  REQUIRE(write_levels(trivial_levels(*cloud, {.chunk_size = 32, .page_chunks = 2}), options, files.levels));
  return files;
}

Scene load(const std::vector<std::byte>& bytes) {
  auto scene = Scene::load(bytes);
  REQUIRE(scene);
  return *std::move(scene);
}

RenderOptions at_detail(float px) {
  RenderOptions options;
  options.detail_px = px;
  return options;
}

}  // namespace

TEST_CASE("at detail 0 a file with levels is drawn like the file without, in every profile that keeps the bytes") {
  const Camera camera = front_camera(90, 60);
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    const Files of = files(profile);
    const Scene plain = load(of.plain), levels = load(of.levels);
    REQUIRE(levels.levels() != nullptr);
    CHECK(plain.levels() == nullptr);
    CHECK(levels.size() == plain.size());
    for (const RenderOptions& options : {RenderOptions(), paper_options(), turbo_options()}) {
      RenderOptions leaves = options;
      leaves.detail_px = 0;
      const Frame expected = render(plain, camera, options), drawn = render(levels, camera, leaves);
      CHECK(drawn.rgb == expected.rgb);
      CHECK(drawn.stats.pages == 0);
      CHECK(drawn.stats.gaussians == plain.size());
    }
    // The file without levels draws nothing else, and refuses a detail above 0.
    CHECK(render(levels, camera, baseline_options()).rgb == render(plain, camera, baseline_options()).rgb);
  }
}

TEST_CASE("a view draws one page per path from leaf to root, and fewer Gaussians the farther away it is") {
  const Scene scene = load(files().levels);
  const std::vector<lod::Page>& pages = scene.levels()->pages();
  Camera camera = front_camera(90, 60);
  std::uint64_t before = scene.size() + 1;
  for (const double back : {0.0, 3.0, 30.0, 300.0, 3e4}) {
    CAPTURE(back);
    camera.world_to_camera[3][2] = front_camera(90, 60).world_to_camera[3][2] + back;
    const auto drawn = drawn_pages(scene, camera, 1);
    REQUIRE(drawn);
    std::vector<int> n_drawn(pages.size(), 0);
    for (const std::uint32_t page : *drawn) ++n_drawn[page];
    std::uint64_t n = 0;
    for (std::size_t i = 0; i < pages.size(); ++i) {
      // Each page decides by itself, from its own record and its parent's.
      const glm::dmat4 to_world = glm::inverse(camera.world_to_camera);
      const lod::Eye eye{{to_world[3][0], to_world[3][1], to_world[3][2]},
                         std::max(camera.fx, camera.fy),
                         static_cast<double>(scene.declarations()->z_near)};
      const auto is_fine = [&](const lod::Page& page) {
        return static_cast<double>(page.error) <= lod::footprint(page.core, eye);
      };
      const bool alone = is_fine(pages[i]) && (i == 0 || !is_fine(pages[pages[i].parent]));
      CHECK(n_drawn[i] == alone);
      if (n_drawn[i] != 0) n += pages[i].count;
      if (pages[i].level != 0) continue;
      int on_the_way = n_drawn[i];
      for (std::uint32_t up = static_cast<std::uint32_t>(i); pages[up].parent != lod::kNoPage;) {
        up = pages[up].parent;
        on_the_way += n_drawn[up];
      }
      CHECK(on_the_way == 1);
    }
    CHECK(n <= before);
    before = n;
    const Frame frame = render(scene, camera, at_detail(1));
    CHECK(frame.stats.gaussians == n);
    CHECK(frame.stats.pages == drawn->size());
  }
  CHECK(before == pages.front().count);
}

TEST_CASE("a limit of Gaussians draws the finest cut that has no more, and says at which detail") {
  const Files of = files();
  const Scene scene = load(of.levels);
  Camera camera = front_camera(90, 60);
  camera.world_to_camera[3][2] += 20;
  const auto all = render(scene, camera, at_detail(0.5F)).stats;
  CHECK(all.detail_px == 0.5F);
  float before = 1e9F;
  for (const std::uint64_t most :
       {std::uint64_t{1}, all.gaussians / 4, all.gaussians / 2, all.gaussians, 2 * all.gaussians}) {
    CAPTURE(most);
    RenderOptions options = at_detail(0.5F);
    options.max_gaussians = most;
    const Frame frame = render(scene, camera, options);
    const auto& stats = frame.stats;
    CHECK(stats.gaussians <= std::max<std::uint64_t>(most, scene.levels()->pages().front().count));
    CHECK(stats.detail_px <= before);
    CHECK(stats.detail_px >= 0.5F);
    CHECK(frame.rgb == render(scene, camera, at_detail(stats.detail_px)).rgb);
    if (most == 1) CHECK(stats.pages == 1);
    if (most >= all.gaussians) CHECK(stats.detail_px == 0.5F);
    before = stats.detail_px;
  }
  // The leaves have the arithmetic of a file without levels, also where they do not fit.
  RenderOptions leaves = at_detail(0);
  leaves.max_gaussians = scene.size();
  CHECK(render(scene, camera, leaves).rgb == render(load(of.plain), camera, {}).rgb);
  CHECK(render(scene, camera, leaves).stats.detail_px == 0);
  leaves.max_gaussians = scene.size() - 1;
  const Frame fewer = render(scene, camera, leaves);
  CHECK(fewer.stats.detail_px >= 0.25F);
  CHECK(fewer.stats.pages > 0);
  RenderOptions as_classic = at_detail(fewer.stats.detail_px);
  as_classic.anti_aliasing = math::AntiAliasing::classic;
  CHECK(fewer.rgb == render(scene, camera, as_classic).rgb);
  // Others have nothing coarser.
  leaves.max_gaussians = 1;
  CHECK(render(load(of.plain), camera, leaves).stats.gaussians == scene.size());
}

TEST_CASE("a time that no frame keeps ends at the root, one that every frame keeps changes nothing") {
  const Scene scene = load(files().levels);
  Camera camera = front_camera(9, 6);
  camera.world_to_camera[3][2] += 20;
  const std::uint64_t all = render(scene, camera, at_detail(0.5F)).stats.gaussians;
  auto renderer = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  Frame frame = Frame::of(camera);
  const auto draw = [&](double frame_ms) {
    RenderOptions options = at_detail(0.5F);
    options.frame_ms = frame_ms;
    return renderer->render(scene, camera, frame.target(), options);
  };
  for (int k = 0; k < 3; ++k) CHECK(draw(1e9)->gaussians == all);
  std::uint64_t before = all;
  for (int k = 0; k < 12; ++k) {
    const auto stats = draw(1e-300);
    REQUIRE(stats);
    CHECK(stats->gaussians <= before);
    before = stats->gaussians;
  }
  CHECK(before == scene.levels()->pages().front().count);
  CHECK(renderer->render(scene, camera, frame.target(), at_detail(0.5F))->gaussians == all);  // without a time
  for (const double wrong : {0.0, -1.0, std::numeric_limits<double>::quiet_NaN()})
    CHECK(draw(wrong).error().code == Errc::bad_argument);
}

TEST_CASE("what draws the leaves alone has no limit of Gaussians") {
  const Scene scene = load(files().levels);
  const Camera camera = front_camera(9, 6);
  auto renderer = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  Frame frame = Frame::of(camera);
  RenderOptions options = baseline_options();
  options.max_gaussians = 10;
  CHECK(renderer->render(scene, camera, frame.target(), options).error().code == Errc::bad_argument);
  CHECK(renderer->render(load(files().plain), camera, frame.target(), options));
  std::vector<Contribution> contributions(scene.size());
  RenderTarget counting = frame.target();
  counting.contributions = contributions;
  options = {.max_gaussians = 10};
  CHECK(renderer->render(scene, camera, counting, options).error().code == Errc::bad_argument);
}

TEST_CASE("a view of a file with levels equals its pages drawn as a scene, with the opacities they were fitted with") {
  const Scene scene = load(files().levels);
  Camera camera = front_camera(90, 60);
  camera.world_to_camera[3][2] += 40;
  const auto drawn = drawn_pages(scene, camera, 2);
  REQUIRE(drawn);
  const auto of_pages = scene_of_pages(scene, *drawn);
  REQUIRE(of_pages);
  RenderOptions mip;
  mip.anti_aliasing = math::AntiAliasing::mip_splatting;
  mip.low_pass = 0.1F;
  const Frame expected = render(*of_pages, camera, mip);
  CHECK(render(scene, camera, at_detail(2)).rgb == expected.rgb);
  // No frame affects the next, even if it sees other pages.
  auto renderer = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  for (const float detail : {2.0F, 0.0F, 9.0F, 2.0F}) {
    Frame frame = Frame::of(camera);
    REQUIRE(renderer->render(scene, camera, frame.target(), at_detail(detail)));
    if (detail == 2) CHECK(frame.rgb == expected.rgb);
  }
  CHECK(load(files().plain).all_pages().error().code == Errc::bad_argument);
}

TEST_CASE("a prefix of a file with levels is drawn as far as it goes") {
  const Files of = files();
  const auto whole = PagedFile::open(of.levels);
  REQUIRE(whole);
  const Camera camera = front_camera(90, 60);
  const std::uint32_t n_pages = whole->n_pages();
  for (const std::uint32_t n_present : {1u, n_pages / 3, n_pages - 1}) {
    CAPTURE(n_present);
    const auto end = static_cast<std::ptrdiff_t>(whole->stored(n_present).offset);
    const Scene scene = load({of.levels.begin(), of.levels.begin() + end});
    REQUIRE(scene.levels() != nullptr);
    CHECK(scene.levels()->n_present() == n_present);
    CHECK(!scene.has_file());
    CHECK(scene.size() < whole->head().header().n_gaussians);
    CHECK(render(scene, camera, at_detail(0)).stats.gaussians == scene.size());
    CHECK(render(scene, camera, at_detail(1)).stats.pages >= 1);
    // What a view lacks is counted as in a streamed scene; from far away the root is enough.
    CHECK(render(scene, camera, at_detail(0)).stats.stream.pages_missing >= (n_present == n_pages - 1 ? 1 : 2));
    CHECK(render(scene, camera, at_detail(1e6F)).stats.stream.pages_missing == 0);
  }
  CHECK(render(load(of.levels), camera, at_detail(0)).stats.stream.pages_missing == 0);
  // All pages, but none of the positions behind them.
  Files behind = files(Profile::direct, true);
  behind.levels.resize(behind.levels.size() - 1);
  CHECK(load(behind.levels).size() == whole->head().header().n_gaussians);
  const auto first = static_cast<std::ptrdiff_t>(whole->stored(0).offset);
  const auto nothing = Scene::load(std::span(of.levels).first(static_cast<std::size_t>(first)));
  REQUIRE(!nothing);
  CHECK(nothing.error().code == Errc::pages_missing);
}

TEST_CASE("an invalid detail is refused, and so is detail for functions that draw leaves alone") {
  const Scene scene = load(files().levels);
  const Camera camera = front_camera(90, 60);
  auto renderer = Renderer::create({.backend = Backend::cpu});
  REQUIRE(renderer);
  Frame frame = Frame::of(camera);
  const auto refused = [&](const RenderOptions& options) {
    const auto stats = renderer->render(scene, camera, frame.target(), options);
    return !stats && stats.error().code == Errc::bad_argument;
  };
  CHECK(refused(at_detail(-1)));
  CHECK(refused(at_detail(std::numeric_limits<float>::quiet_NaN())));
  CHECK(refused(at_detail(std::numeric_limits<float>::infinity())));
  RenderOptions baseline = baseline_options();
  baseline.detail_px = 1;
  CHECK(refused(baseline));
  std::vector<Contribution> contributions(scene.size());
  RenderTarget target = frame.target();
  target.contributions = contributions;
  CHECK(renderer->render(scene, camera, target));
  CHECK(!renderer->render(scene, camera, target, at_detail(1)));
}
