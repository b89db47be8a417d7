// streamed_scene_test.cpp - scenes drawn while they are read: complete pictures, coarse ones, and failures.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <atomic>
#include <filesystem>
#include <fstream>
#include <limits>
#include <optional>
#include <set>
#include <thread>

#include "pages/scheduler.hpp"
#include "scene_of_pages.hpp"
#include "streamed_fixture.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

TEST_CASE("a complete picture equals the whole file's, byte for byte, in every profile and at every detail") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    CAPTURE(static_cast<int>(profile));
    const Bytes bytes = town({.profile = profile});
    const Scene all = whole(bytes);
    const Scene scene = streamed(bytes);
    CHECK(scene.size() == all.size());
    CHECK(scene.sh_degree() == all.sh_degree());
    Renderer one = cpu_renderer(1), two = cpu_renderer(2), reference = cpu_renderer();
    std::uint64_t least = ~std::uint64_t{0}, most = 0;
    const std::vector<Camera> cameras = town_cameras(1, 12);
    for (const float detail : {4.0F, 1.0F, 0.5F, 0.0F}) {
      for (std::size_t i = 0; i < cameras.size(); ++i) {
        CAPTURE(detail);
        CAPTURE(i);
        Renderer& renderer = i % 2 == 0 ? one : two;
        const auto complete = renderer.refine(scene, cameras[i], kLong, at_detail(detail));
        REQUIRE(complete);
        REQUIRE(*complete);
        const Frame expected = draw(reference, all, cameras[i], at_detail(detail));
        const Frame frame = draw(renderer, scene, cameras[i], at_detail(detail));
        CHECK(is_same_picture(frame, expected));
        CHECK(frame.stats.stream.pages_missing == 0);
        CHECK(frame.stats.stream.detail_reached_px <= static_cast<double>(detail));
        CHECK(frame.stats.gaussians <= expected.stats.gaussians);
        if (detail == 1) least = std::min(least, frame.stats.pages), most = std::max(most, frame.stats.pages);
      }
    }
    CHECK(least < most);  // the views differ
    CHECK(scene.status());
    CHECK(scene.stats().bytes_read <= 2 * bytes.size());
  }
}

TEST_CASE("with a limit of Gaussians, too, a complete picture equals the whole file's, at the same detail") {
  const Bytes bytes = town();
  const Scene all = whole(bytes);
  const Scene scene = streamed(bytes);
  Renderer renderer = cpu_renderer(1), reference = cpu_renderer();
  const std::uint64_t root = all.levels()->pages().front().count;
  std::set<float> details;
  for (const Camera& camera : town_cameras(2, 8)) {
    for (const float detail : {0.0F, 1.0F}) {
      for (const unsigned share : {20U, 5U, 2U, 1U}) {
        RenderOptions options = at_detail(detail);
        const std::uint64_t most = options.max_gaussians.emplace(all.size() / share);
        const auto complete = renderer.refine(scene, camera, kLong, options);
        REQUIRE(complete);
        REQUIRE(*complete);
        const Frame expected = draw(reference, all, camera, options);
        const Frame frame = draw(renderer, scene, camera, options);
        CHECK(is_same_picture(frame, expected));
        CHECK(frame.stats.detail_px == expected.stats.detail_px);
        CHECK(frame.stats.detail_px >= detail);
        CHECK(frame.stats.stream.pages_missing == 0);
        CHECK(expected.stats.gaussians <= std::max(most, root));
        details.insert(frame.stats.detail_px);
      }
    }
  }
  CHECK(details.size() > 5);
}

TEST_CASE("a streamed scene, too, is drawn as its root in a time that no frame keeps") {
  const Bytes bytes = town();
  const Scene scene = streamed(bytes);
  Renderer renderer = cpu_renderer();
  const Camera camera = town_cameras(2, 1).front();
  CHECK(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
  RenderOptions options = at_detail(0);
  options.frame_ms = 1e-300;
  std::uint64_t pages = draw(renderer, scene, camera, options).stats.pages;
  CHECK(pages > 1);
  for (int k = 0; k < 20; ++k) pages = draw(renderer, scene, camera, options).stats.pages;
  CHECK(pages == 1);
  CHECK(renderer.refine(scene, camera, kLong, options) == true);
}

TEST_CASE("the first picture is the root, and there are no holes until the picture is complete") {
  const Bytes bytes = town();
  const Scene all = whole(bytes);
  const auto script = std::make_shared<Script>();
  const ByteSource::Traits slow{.reads_at_once = 1, .most_bytes = 16 << 10, .gap_bytes = 0};
  const Scene scene = streamed(bytes, script, {.prefetch = false, .traits = slow});
  script->is_shut = true;
  Renderer renderer = cpu_renderer(), reference = cpu_renderer();
  const Camera camera = camera_at({0, 3, 26}, {0, 0, 0});
  const RenderOptions options = at_detail(0.5F);
  const std::array<std::uint32_t, 1> root{0};
  const auto coarsest = scene_of_pages(all, root);
  REQUIRE(coarsest);
  RenderOptions mip = options;
  mip.anti_aliasing = math::AntiAliasing::mip_splatting;
  mip.low_pass = 0.1F;
  const Frame first = draw(renderer, scene, camera, options);
  CHECK(is_same_picture(first, draw(reference, *coarsest, camera, mip)));
  CHECK(first.stats.pages == 1);
  CHECK(first.stats.stream.pages_resident == 1);
  CHECK(first.stats.stream.pages_missing > 0);
  const Frame complete = draw(reference, all, camera, options);
  const auto covered = [](const Frame& frame) {
    return std::ranges::count_if(frame.alpha, [](float alpha) { return alpha > 0.02F; });
  };
  REQUIRE(covered(first) > 500);
  double before = first.stats.stream.detail_reached_px;
  int n_between = 0;
  std::uint64_t n_seen = first.stats.stream.pages_resident;
  for (bool is_done = false; !is_done;) {
    // One more read, or several for large pages.
    await([&] {
      script->let_one_go();
      return scene.stats().pages_resident > n_seen;
    });
    const Frame frame = draw(renderer, scene, camera, options);
    n_seen = frame.stats.stream.pages_resident;
    // Still camera: the error only falls, and drawn ancestors keep every place covered.
    CHECK(frame.stats.stream.detail_reached_px <= before);
    CHECK(covered(frame) > 0.8 * static_cast<double>(std::min(covered(first), covered(complete))));
    before = frame.stats.stream.detail_reached_px;
    is_done = frame.stats.stream.pages_missing == 0;
    n_between += !is_done;
    if (is_done) CHECK(is_same_picture(frame, complete));
  }
  CHECK(n_between > 2);
  CHECK(before <= 0.5);
}

TEST_CASE("the largest projected error is read first, adjacent pages together, and several reads at a time") {
  const Bytes bytes = town({.n = 40000});
  const auto script = std::make_shared<Script>();
  const ByteSource::Traits traits{.reads_at_once = 3, .most_bytes = 64 << 10, .gap_bytes = 4096};
  const Scene scene = streamed(bytes, script, {.prefetch = false, .traits = traits});
  const int n_opening = script->n_reads;
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 30, 40}, {0, 0, 0});
  for (float coarse = 4096; draw(renderer, scene, camera, at_detail(coarse)).stats.pages < 60; coarse /= 1.5F)
    REQUIRE(renderer.refine(scene, camera, kLong, at_detail(coarse)) == true);
  script->is_shut = true;
  draw(renderer, scene, camera, at_detail(0));
  await([&] { return script->n_at_once == 3; });
  script->open_gate();
  REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0)));
  const StreamStats stats = scene.stats();
  CHECK(script->most_at_once == 3);
  CHECK(stats.pages_resident > 200);
  CHECK(script->n_reads - n_opening < static_cast<int>(stats.pages_resident) / 4);
  CHECK(stats.bytes_read == script->n_bytes);
  CHECK(stats.bytes_decoded > 0);
  CHECK(stats.bytes_evicted == 0);
  CHECK(stats.bytes_uploaded == 0);
}

TEST_CASE("a pool smaller than a view gives a coarser picture, reports its error, and comes to rest") {
  const Bytes bytes = town({.n = 60000});
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Renderer reference = cpu_renderer();
  double finer = -1;
  std::uint64_t most = 0;
  for (const std::uint64_t memory :
       {std::uint64_t{64} << 20, std::uint64_t{4} << 20, std::uint64_t{2500} << 10, std::uint64_t{1700} << 10}) {
    CAPTURE(memory);
    const auto pool = StreamPool::create({.host_memory = memory});
    REQUIRE(pool);
    const auto script = std::make_shared<Script>();
    const Scene scene = streamed(
        bytes, script, {.pool = *pool, .traits = {.reads_at_once = 2, .most_bytes = 64 << 10, .gap_bytes = 4096}});
    Renderer renderer = cpu_renderer();
    const auto complete = renderer.refine(scene, camera, kLong, at_detail(0));
    REQUIRE(complete);
    CHECK(*complete == (memory >= std::uint64_t{64} << 20));
    const Frame frame = draw(renderer, scene, camera, at_detail(0));
    CHECK((frame.stats.stream.pages_missing == 0) == *complete);
    CHECK(frame.stats.stream.detail_reached_px > finer);
    finer = frame.stats.stream.detail_reached_px;
    CHECK(pool->host_bytes() <= memory);
    most = std::max(most, pool->host_bytes());
    // At rest: the same picture is drawn again, and nothing is read for it.
    const int n_reads = script->n_reads;
    for (int i = 0; i < 5; ++i) {
      CHECK(renderer.refine(scene, camera, kLong, at_detail(0)) == *complete);  // once threads have checked again
      CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0)), frame));
    }
    CHECK(script->n_reads == n_reads);
    // Elsewhere, this view's pages make room.
    const Camera elsewhere = camera_at({18, 2, 18}, {30, 0, 30});
    CHECK(renderer.refine(scene, elsewhere, kLong, at_detail(2)));
    CHECK(pool->host_bytes() <= memory);
  }
  CHECK(most > 0);
}

TEST_CASE("a scene too large for a pool is refused with the bytes required, and opens in a sufficient one") {
  const Bytes bytes = town();
  CHECK(StreamPool::create({.host_memory = 0}).error().code == Errc::bad_argument);
  for (const std::uint64_t memory : {std::uint64_t{1}, std::uint64_t{100} << 10, std::uint64_t{400} << 10}) {
    std::uint64_t needed = memory;
    for (int i = 0; i < 10; ++i) {
      const auto scene = try_streaming(bytes, std::make_shared<Script>(), {.memory = needed});
      if (scene) break;
      REQUIRE(scene.error().code == Errc::limit_exceeded);
      REQUIRE(scene.error().found == needed);
      REQUIRE(scene.error().expected > needed);
      needed = scene.error().expected;
    }
    const auto scene = try_streaming(bytes, std::make_shared<Script>(), {.memory = needed});
    REQUIRE(scene);
    Renderer renderer = cpu_renderer();
    const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
    CHECK(draw(renderer, *scene, camera).stats.pages >= 1);
    CHECK(renderer.refine(*scene, camera, kLong));
  }
  // The memory of a scene that failed to open is free again.
  const auto pool = StreamPool::create({.host_memory = 300 << 10});
  REQUIRE(pool);
  CHECK(!try_streaming(bytes, std::make_shared<Script>(), {.pool = *pool}));
  CHECK(pool->host_bytes() == 0);
}

TEST_CASE("files without levels, and files damaged before their pages, do not open") {
  const Bytes bytes = town({.n = 3000});
  const auto code_of = [](const Bytes& damaged) {
    const auto scene = try_streaming(damaged, std::make_shared<Script>());
    return scene ? Errc{} : scene.error().code;
  };
  EncodeOptions options;
  const auto plain = encode(cloud_of(random_splats(5, 3000), 1).view(), options);
  REQUIRE(plain);
  CHECK(code_of(*plain) == Errc::missing_section);
  CHECK(code_of({}) == Errc::truncated);
  CHECK(code_of(Bytes(100000, std::byte{7})) == Errc::bad_magic);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  Bytes damaged = bytes;
  damaged[file->head().find(SectionType::levels)->offset + 100] ^= std::byte{1};
  CHECK(code_of(damaged) == Errc::checksum_mismatch);
  damaged = bytes;
  damaged[file->stored(0).offset + 100] ^= std::byte{1};
  CHECK(code_of(damaged) == Errc::checksum_mismatch);  // the root
  CHECK(code_of({bytes.begin(), bytes.begin() + 300}) == Errc::truncated);
  for (const bool is_streamed : {false, true}) {
    OpenOptions how;
    if (is_streamed) how.pool = StreamPool::create().value();
    CHECK(Scene::open(std::unique_ptr<ByteSource>(), how).error().code == Errc::bad_argument);
    CHECK(Scene::open("/nowhere/to.rgs", how).error().code == Errc::open_failed);
  }
  const auto script = std::make_shared<Script>();
  script->fails = true;
  CHECK(try_streaming(bytes, script).error().code == Errc::read_failed);
}

TEST_CASE("a damaged page is never drawn: its ancestor stays, status() names it, and all other pages arrive") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Renderer renderer = cpu_renderer(), reference = cpu_renderer();
  const std::uint32_t page = file->n_pages() - file->n_pages() / 3;
  const StoredPage& stored = file->stored(page);
  const auto script = std::make_shared<Script>();
  script->flip_from = stored.offset + 40, script->flip_to = stored.offset + 41;
  const Scene scene = streamed(bytes, script);
  const auto complete = renderer.refine(scene, camera, kLong, at_detail(0));
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::checksum_mismatch);
  CHECK(complete.error().offset == stored.offset);
  REQUIRE(!scene.status());
  CHECK(scene.status().error().code == Errc::checksum_mismatch);
  const Frame frame = draw(renderer, scene, camera, at_detail(0));
  const lod::Page& above = file->pages()[file->pages()[page].parent];
  CHECK(frame.stats.stream.pages_missing == above.n_children);
  CHECK(frame.stats.stream.detail_reached_px > 0);
  CHECK(script->n_flipped == 2 * pages::kMostTries);  // each time twice, then never again
  CHECK(!renderer.refine(scene, camera, kLong, at_detail(0)));
  CHECK(script->n_flipped == 2 * pages::kMostTries);
  // A view that does not need it is complete.
  CHECK(renderer.refine(scene, camera, kLong, at_detail(100)) == true);

  // Damaged once in transit: read again.
  const auto once = std::make_shared<Script>();
  once->flip_from = stored.offset + 40, once->flip_to = stored.offset + 41;
  once->flips_once = true;
  const Scene mended = streamed(bytes, once);
  CHECK(renderer.refine(mended, camera, kLong, at_detail(0)) == true);
  CHECK(once->n_flipped == 1);
  CHECK(mended.status());
  const Scene all = whole(bytes);
  CHECK(is_same_picture(draw(renderer, mended, camera, at_detail(0)), draw(reference, all, camera, at_detail(0))));
}

TEST_CASE("a source that sometimes fails is retried, one that always fails is a status, and both draw resident pages") {
  const Bytes bytes = town();
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Renderer renderer = cpu_renderer(), reference = cpu_renderer();
  const auto sometimes = std::make_shared<Script>();
  const Scene scene =
      streamed(bytes, sometimes, {.traits = {.reads_at_once = 2, .most_bytes = 64 << 10, .gap_bytes = 4096}});
  sometimes->fails_every = 9;
  CHECK(renderer.refine(scene, camera, kLong, at_detail(0.5F)) == true);
  CHECK(scene.status());  // past failures are no failures
  CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0.5F)), draw(reference, all, camera, at_detail(0.5F))));

  const auto never = std::make_shared<Script>();
  const Scene dead = streamed(bytes, never);
  never->fails = true;
  const auto complete = renderer.refine(dead, camera, kLong, at_detail(0.5F));  // long before that
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::read_failed);
  CHECK(dead.status().error().code == Errc::read_failed);
  CHECK(draw(renderer, dead, camera, at_detail(0.5F)).stats.pages == 1);
  never->fails = false;
  CHECK(renderer.refine(dead, camera, kLong, at_detail(100)) == true);
}

TEST_CASE("refine() waits no longer than it is told to") {
  const Bytes bytes = town();
  const auto script = std::make_shared<Script>();
  const Scene scene = streamed(bytes, script);
  script->is_shut = true;
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  for (const double seconds : {0.0, -1.0, 0.05})
    CHECK(renderer.refine(scene, camera, seconds, at_detail(0.5F)) == false);
  script->open_gate();
  CHECK(renderer.refine(scene, camera, kLong, at_detail(0.5F)) == true);
  CHECK(renderer.refine(scene, camera, 0, at_detail(0.5F)) == true);
}

TEST_CASE("scenes close while their source reads, and release their memory") {
  const Bytes bytes = town();
  const auto pool = StreamPool::create({.host_memory = 64 << 20});
  REQUIRE(pool);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Renderer renderer = cpu_renderer();
  for (int i = 0; i < 20; ++i) {
    const auto script = std::make_shared<Script>();
    std::optional<Scene> scene = streamed(bytes, script, {.pool = *pool});
    script->is_shut = i % 2 == 0;
    std::optional<Scene> copy = *scene;
    draw(renderer, *scene, camera, at_detail(0.5F));
    scene.reset();
    CHECK(pool->host_bytes() > 0);
    if (i % 3 == 0) draw(renderer, *copy, camera, at_detail(0.5F));
    copy.reset();
    CHECK(pool->host_bytes() == 0);
  }
}

TEST_CASE("without a pool the whole file is read from its source, and drawn like a loaded one") {
  const Bytes bytes = town();
  const auto script = std::make_shared<Script>();
  const ByteSource::Traits small{.most_bytes = 10'000};
  const auto scene = Scene::open(std::make_unique<ScriptedSource>(bytes, script, small));
  REQUIRE(scene);
  CHECK_FALSE(scene->is_streamed());
  CHECK(scene->stats().bytes_read == 0);
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  CHECK(renderer.refine(*scene, camera, 0) == true);
  for (const float detail : {0.0F, 4.0F})
    CHECK(draw(renderer, *scene, camera, at_detail(detail)).rgb ==
          draw(renderer, whole(bytes), camera, at_detail(detail)).rgb);
  script->fails = true;
  CHECK(Scene::open(std::make_unique<ScriptedSource>(bytes, script, small)).error().code == Errc::read_failed);
  CHECK(streamed(bytes).view().error().code == Errc::bad_argument);
}

TEST_CASE("the source's reads of opening are limited in time, later ones are not") {
  const Bytes bytes = town();
  const auto script = std::make_shared<Script>();
  OpenOptions options;
  options.pool = StreamPool::create().value();
  options.url.open_seconds = 7;
  REQUIRE(Scene::open(std::make_unique<ScriptedSource>(bytes, script), options));
  CHECK(script->limits == std::vector<double>{7, std::numeric_limits<double>::infinity()});
}

TEST_CASE("cancelling the source gives a status, and the scene continues with its resident pages") {
  const Bytes bytes = town();
  const auto script = std::make_shared<Script>();
  auto source = std::make_unique<ScriptedSource>(bytes, script);
  ByteSource* const held = source.get();
  const auto scene = Scene::open(std::move(source), {.pool = StreamPool::create().value()});
  REQUIRE(scene);
  script->delay_us = 500;
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  draw(renderer, *scene, camera, at_detail(0.5F));
  held->cancel();
  const auto complete = renderer.refine(*scene, camera, kLong, at_detail(0));
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::cancelled);
  CHECK(draw(renderer, *scene, camera, at_detail(0.5F)).stats.pages >= 1);
}

TEST_CASE("a file that changes under a scene is a status, and old pages stay") {
  const Bytes bytes = town();
  const TemporaryFolder folder;
  const auto path = folder.path() / "town.rgs";
  const auto write = [&](const Bytes& content) {
    std::ofstream(path, std::ios::binary)
        .write(reinterpret_cast<const char*>(content.data()), static_cast<std::streamsize>(content.size()));
  };
  write(bytes);
  const auto scene = Scene::open(path.string(), {.pool = StreamPool::create().value()});
  REQUIRE(scene);
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  REQUIRE(renderer.refine(*scene, camera, kLong, at_detail(4)) == true);
  const Frame before = draw(renderer, *scene, camera, at_detail(4));
  write(Bytes(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(bytes.size() / 3)));
  const auto complete = renderer.refine(*scene, camera, kLong, at_detail(0));
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::read_failed);
  CHECK(is_same_picture(draw(renderer, *scene, camera, at_detail(4)), before));
}

TEST_CASE("two scenes share a pool: the larger error has priority, and each gets what the other no longer needs") {
  const Bytes first = town({.n = 60000, .seed = 1}), second = town({.n = 60000, .seed = 2});
  const Scene all_second = whole(second);
  const auto pool = StreamPool::create({.host_memory = std::uint64_t{3} << 20});
  REQUIRE(pool);
  const ByteSource::Traits traits{.reads_at_once = 2, .most_bytes = 64 << 10, .gap_bytes = 4096};
  const Scene a = streamed(first, std::make_shared<Script>(), {.pool = *pool, .traits = traits});
  const Scene b = streamed(second, std::make_shared<Script>(), {.pool = *pool, .traits = traits});
  Renderer renderer = cpu_renderer(), reference = cpu_renderer();
  const Camera near = camera_at({0, 6, 20}, {0, 0, 0}), far = camera_at({0, 60, 200}, {0, 0, 0});
  CHECK(renderer.refine(a, near, kLong, at_detail(0)) == false);  // all that it can get
  const double alone = draw(renderer, a, near, at_detail(0)).stats.stream.detail_reached_px;
  CHECK(pool->host_bytes() <= pool->host_memory());
  // From now on only the other one is viewed: after a while the first no longer counts.
  await([&] { return renderer.refine(b, near, kLong, at_detail(0)).has_value() && a.stats().bytes_evicted > 0; });
  CHECK(renderer.refine(b, near, kLong, at_detail(0)));
  CHECK(a.stats().bytes_evicted > 0);
  const double other = draw(renderer, b, near, at_detail(0)).stats.stream.detail_reached_px;
  CHECK(other < 3 * alone);
  CHECK(other > alone / 3);
  CHECK(renderer.refine(b, far, kLong, at_detail(1)) == true);
  CHECK(is_same_picture(draw(renderer, b, far, at_detail(1)), draw(reference, all_second, far, at_detail(1))));
  CHECK(pool->host_bytes() <= pool->host_memory());
}

TEST_CASE("several renderers draw one scene at once, each its own view, while it is read") {
  const Bytes bytes = town();
  const Scene all = whole(bytes);
  const auto script = std::make_shared<Script>();
  const Scene scene = streamed(bytes, script, {.memory = std::uint64_t{64} << 20});
  script->delay_us = 200;
  std::atomic<int> n_wrong{0};
  std::vector<std::thread> threads;
  for (unsigned t = 0; t < 4; ++t) {
    threads.emplace_back([&, t] {
      auto renderer = Renderer::create({.backend = Backend::cpu, .threads = 1});
      auto reference = Renderer::create({.backend = Backend::cpu, .threads = 1});
      const std::vector<Camera> cameras = town_cameras(100 + t, 8);
      for (const Camera& camera : cameras) {
        Frame frame = Frame::of(camera), expected = Frame::of(camera);
        for (int i = 0; i < 3; ++i) n_wrong += !renderer->render(scene, camera, frame.target(), at_detail(0.5F));
        const auto complete = renderer->refine(scene, camera, kLong, at_detail(0.5F));
        n_wrong += !complete || !*complete;
        n_wrong += !renderer->render(scene, camera, frame.target(), at_detail(0.5F));
        n_wrong += !reference->render(all, camera, expected.target(), at_detail(0.5F));
        n_wrong += !is_same_picture(frame, expected);
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  CHECK(n_wrong == 0);
}

TEST_CASE("options that streaming does not support are refused before anything is read") {
  const Bytes bytes = town({.n = 3000});
  const Scene scene = streamed(bytes);
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Frame frame = Frame::of(camera);
  const auto code = [&](const RenderOptions& options) {
    const auto stats = renderer.render(scene, camera, frame.target(), options);
    const auto complete = renderer.refine(scene, camera, 0, options);
    CHECK(stats.has_value() == complete.has_value());
    return stats ? Errc{} : stats.error().code;
  };
  CHECK(code(at_detail(-1)) == Errc::bad_argument);
  RenderOptions baseline = baseline_options();
  CHECK(code(baseline) == Errc{});  // leaves
  baseline.detail_px = 1;
  CHECK(code(baseline) == Errc::bad_argument);
  CHECK(code({.near_plane = -1}) == Errc::bad_argument);
  std::vector<Contribution> contributions(scene.size());
  RenderTarget target = frame.target();
  target.contributions = contributions;
  CHECK(renderer.render(scene, camera, target).error().code == Errc::bad_argument);
  Camera broken = camera;
  broken.fx = 0;
  CHECK(renderer.render(scene, broken, frame.target()).error().code == Errc::bad_camera);
  CHECK(renderer.refine(scene, broken, 0).error().code == Errc::bad_camera);
  RenderTarget small = frame.target();
  small.rgb = small.rgb.first(3);
  CHECK(renderer.render(scene, camera, small).error().code == Errc::bad_argument);
  // Every pipeline draws the whole file's picture.
  const Scene all = whole(bytes);
  Renderer reference = cpu_renderer();
  for (RenderOptions options : {baseline_options(), paper_options(), turbo_options()}) {
    for (const float detail : {0.0F, 1.0F}) {
      if (detail > 0 && options.pipeline == Pipeline::baseline) continue;
      options.detail_px = detail;
      CHECK(renderer.refine(scene, camera, kLong, options) == true);
      CHECK(is_same_picture(draw(renderer, scene, camera, options), draw(reference, all, camera, options)));
    }
  }
}

TEST_CASE("a long table is read as far as views need it, and a damaged one ends where it is known") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const SectionEntry& table = *file->head().find(SectionType::levels);
  REQUIRE(table.stored_bytes > 200 << 10);
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  Renderer renderer = cpu_renderer(), reference = cpu_renderer();
  const auto script = std::make_shared<Script>();
  const ByteSource::Traits traits{.reads_at_once = 3, .most_bytes = 128 << 10, .gap_bytes = 4096};
  const Scene scene = streamed(bytes, script, {.traits = traits});
  CHECK(script->n_bytes < (64 << 10) + 8192);
  const Frame first = draw(renderer, scene, camera, at_detail(0));
  CHECK(first.stats.pages >= 1);
  CHECK(first.stats.stream.pages_missing > 0);
  CHECK(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
  CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0)), draw(reference, all, camera, at_detail(0))));
  CHECK(scene.status());

  // A bit of a late record, and one that only the hash of the whole table reveals.
  for (const std::uint64_t at :
       {table.offset + 64 + 112 * (file->n_pages() - 9) + 20, table.offset + 64 + 112 * (file->n_pages() / 2) + 44}) {
    CAPTURE(at - table.offset);
    const auto flipping = std::make_shared<Script>();
    flipping->flip_from = at, flipping->flip_to = at + 1;
    const Scene damaged = streamed(bytes, flipping, {.traits = traits});
    const auto complete = renderer.refine(damaged, camera, kLong, at_detail(0));
    REQUIRE(!complete);  // wherever it is
    CHECK(exit_code(complete.error().code) == 4);
    const Frame frame = draw(renderer, damaged, camera, at_detail(0));
    CHECK(frame.stats.pages >= 1);
    CHECK(std::ranges::count_if(frame.alpha, [](float alpha) { return alpha > 0.02F; }) > 500);
    REQUIRE(!damaged.status());
    CHECK(exit_code(damaged.status().error().code) == 4);
  }
}

TEST_CASE("a file whose end is missing is drawn as far as it goes, and status() says so") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const std::uint32_t n = file->n_pages() / 2;
  const Bytes beginning(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(file->stored(n).offset + 10));
  const Scene scene = streamed(beginning);
  Renderer renderer = cpu_renderer();
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  const auto complete = renderer.refine(scene, camera, kLong, at_detail(0));
  REQUIRE(!complete);
  CHECK(complete.error().code == Errc::truncated);
  const Frame frame = draw(renderer, scene, camera, at_detail(0));
  CHECK(frame.stats.pages > 10);
  CHECK(frame.stats.stream.pages_missing > 0);
  CHECK(!scene.status());
  CHECK(renderer.refine(scene, camera, kLong, at_detail(100)) == true);
  // Present pages: the children of every complete group whose ancestors are present.
  const Camera over = camera_at({0, 60, 120}, {0, 0, 0});
  for (const double share : {0.3, 0.7, 0.95}) {
    CAPTURE(share);
    const auto cut = static_cast<std::uint32_t>(share * file->n_pages());
    const Bytes prefix(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(file->stored(cut).offset + 1));
    std::vector<char> is_there(file->n_pages(), 0);
    is_there[0] = 1;
    for (std::uint32_t page = 0; page < file->n_pages(); ++page) {
      const lod::Page& above = file->pages()[page];
      if (above.n_children == 0 || is_there[page] == 0 || above.first_child + above.n_children > cut) continue;
      std::fill_n(is_there.begin() + above.first_child, above.n_children, char{1});
    }
    const Scene part = streamed(prefix);
    CHECK(!renderer.refine(part, over, kLong, at_detail(0)));
    CHECK(part.stats().pages_resident == static_cast<std::uint64_t>(std::ranges::count(is_there, char{1})));
  }
}
