// streamed_device_test.cpp - streamed scenes on the device: the pictures of whole files, and small pools.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <atomic>
#include <thread>

#include "common/frame.hpp"
#include "device_fixture.hpp"
#include "grid_scene.hpp"
#include "skip.hpp"
#include "stream/slot_plan.hpp"
#include "streamed_fixture.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr ByteSource::Traits kTraits{.reads_at_once = 3, .most_bytes = 64 << 10, .gap_bytes = 4096};

Renderer device_renderer() {
  auto renderer = Renderer::create({.backend = Backend::cuda});
  require_ok(renderer);
  return *std::move(renderer);
}

/// `page_memory`: of the device, beside a workspace with room for all frames here.
StreamPool device_pool(std::uint64_t page_memory, std::uint64_t host_memory = std::uint64_t{64} << 20,
                       std::uint64_t workspace = std::uint64_t{1} << 30) {
  auto pool = StreamPool::create(
      {.host_memory = host_memory, .device_memory = page_memory + workspace, .device_workspace = workspace});
  require_ok(pool);
  return *std::move(pool);
}

Scene streamed_in(const StreamPool& pool, const Bytes& bytes) {
  return streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
}

struct Way {
  const char* name;
  RenderOptions options;
  std::vector<float> details;
};
std::vector<Way> ways() {
  RenderOptions scattered = paper_options();
  scattered.paper.front_end = PaperSteps::FrontEnd::separate;
  RenderOptions fp32 = turbo_options();
  fp32.turbo.tensor_cores = false;
  return {{"turbo", turbo_options(), {1, 0}},
          {"turbo in FP32", fp32, {1}},
          {"paper", paper_options(), {1, 0}},
          {"paper, separate", scattered, {1}},
          {"baseline", baseline_options(), {0}}};
}

/// Colour only, for which turbo has its own path.
std::vector<float> colours(Renderer& renderer, const auto& scene, const Camera& camera, const RenderOptions& options) {
  std::vector<float> rgb(3 * static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height), NAN);
  require_ok(renderer.render(scene, camera, {.rgb = rgb}, options));
  return rgb;
}

std::vector<Camera> cameras(unsigned seed, int n) {
  auto all = town_cameras(seed, n);
  for (Camera& camera : all) camera = resized(camera, sized(320, 160, 64), sized(200, 96, 48));
  all.back() = panorama_of(all.back());
  return all;
}

Bytes in_pages(std::span<const Splat> splats) {
  EncodeOptions options;
  options.chunk_size = 32;
  const auto plain = encode(cloud_of(splats, 3).view(), options);
  require_ok(plain);
  const auto cloud = decode(*plain);
  require_ok(cloud);
  options.order = Order::morton;
  Bytes bytes;
  require_ok(write_levels(trivial_levels(*cloud, {.chunk_size = 32, .page_chunks = 2}), options, bytes));
  return bytes;
}

/// Two Gaussians at each of n / 2 positions before front_camera(), at different depths.
std::vector<Splat> pairs(unsigned seed, int n) {
  Random random(seed);
  std::vector<Splat> splats;
  for (int i = 0; i < n / 2; ++i) {
    const double x = random.uniform(-2, 2), y = random.uniform(-2, 2), z = random.uniform(2, 5);
    for (const bool is_first : {true, false}) {
      splats.push_back(splat_at(x, y, z, 0.1, is_first ? 0.9 : 0.5));
      for (int c = 0; c < 3; ++c) splats.back().sh[c] = is_first == (c == 0) ? 1.5F : -1.5F;
    }
  }
  return splats;
}

/// At one depth, in one tile in the middle of the image.
std::vector<Splat> wall(unsigned seed, int n) {
  Random random(seed);
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    splats.push_back(splat_at(random.uniform(0.01, 0.05), random.uniform(0.01, 0.05), 3, 0.003, 0.3));
    for (int c = 0; c < 3; ++c) splats.back().sh[c] = static_cast<float>(random.uniform(-1.5, 1.5));
  }
  return splats;
}

std::uint64_t device_memory() {
  std::size_t free = 0, total = 0;
  require_cuda(cudaMemGetInfo(&free, &total));
  return total;
}

}  // namespace

TEST_CASE("on the device a complete picture equals the whole file's, byte for byte, in every pipeline") {
  if (!device_answers()) return;
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    if (race_sizes() && profile != Profile::direct) continue;
    for (const int sh_degree : sized<std::vector<int>>({0, 1, 2, 3}, {1, 3}, {1})) {
      const Bytes bytes = town({.profile = profile, .n = sized(20000, 6000, 1000), .sh_degree = sh_degree});
      const Scene all = whole(bytes);
      const StreamPool pool = device_pool(32 << 20);
      const Scene scene = streamed_in(pool, bytes);
      Renderer renderer = device_renderer(), reference = device_renderer();
      for (const Way& way : ways()) {
        for (const float detail : way.details) {
          RenderOptions options = way.options;
          options.detail_px = detail;
          for (const Camera& camera : cameras(3, sized(6, 3, 1))) {
            CAPTURE(way.name);
            CAPTURE(detail);
            CAPTURE(sh_degree);
            REQUIRE(renderer.refine(scene, camera, kLong, options) == true);
            CHECK(colours(renderer, scene, camera, options) == colours(reference, all, camera, options));
            CHECK(is_same_picture(draw(renderer, scene, camera, options), draw(reference, all, camera, options)));
          }
        }
      }
      CHECK(scene.stats().bytes_uploaded > 0);
    }
  }
}

TEST_CASE("pages that many threads send at once, in rings of any size, equal the file's") {
  if (!device_answers()) return;
  const Bytes bytes = town({.n = sized(60000, 20000, 2000), .sh_degree = 1});
  const Scene all = whole(bytes);
  const Camera camera = resized(camera_at({0, 30, 40}, {0, 0, 0}), sized(320, 160, 64), sized(200, 96, 48));
  Renderer reference = device_renderer();
  const std::vector<float> expected = colours(reference, all, camera, at_detail(0));
  // Runs of one group and of many; rings of eight pages and of two.
  for (const int reads_at_once : {16, 1}) {
    for (const std::uint64_t host_memory : {std::uint64_t{256} << 20, std::uint64_t{6} << 20}) {
      CAPTURE(reads_at_once);
      CAPTURE(host_memory);
      for (int turn = 0; turn < sized(10, 2, 1); ++turn) {
        const StreamPool pool = device_pool(std::uint64_t{32} << 20, host_memory);
        const Scene scene = streamed(
            bytes, std::make_shared<Script>(),
            {.pool = pool, .traits = {.reads_at_once = reads_at_once, .most_bytes = 256 << 10, .gap_bytes = 4096}});
        Renderer renderer = device_renderer();
        // Frames of resident pages, while more arrive.
        Frame frame = Frame::of(camera);
        do {
          const auto drawn = renderer.render(scene, camera, frame.target(), at_detail(0));
          require_ok(drawn);
          frame.stats = *drawn;
        } while (frame.stats.stream.pages_missing > 0 && scene.status());
        CHECK(scene.status());
        REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
        CHECK(colours(renderer, scene, camera, at_detail(0)) == expected);
        CHECK(scene.stats().bytes_uploaded == scene.stats().bytes_decoded);
      }
    }
  }
}

TEST_CASE("equal depths are drawn in the order of the file, whatever slots they are in") {
  if (!device_answers()) return;
  // A grid seen along its axis: many means at one depth, in pages that arrive in any order.
  const Bytes bytes = in_pages(grid_splats(5, sized(8000, 3000, 600)));
  const Scene all = whole(bytes);
  Renderer reference = device_renderer();
  const Camera camera = front_camera(sized(256, 128, 64), sized(192, 96, 48));
  for (const Way& way : ways()) {
    RenderOptions leaves = way.options;
    leaves.detail_px = 0;
    const std::vector<float> expected = colours(reference, all, camera, leaves);
    for (int i = 0; i < 3; ++i) {
      CAPTURE(way.name);
      const StreamPool pool = device_pool(16 << 20);
      const Scene scene = streamed_in(pool, bytes);
      Renderer renderer = device_renderer();
      REQUIRE(renderer.refine(scene, camera, kLong, leaves) == true);
      CHECK(colours(renderer, scene, camera, leaves) == expected);
    }
  }
}

TEST_CASE("equal depths of a streamed frame: pairs, a grid, and more in a tile than a round sorts") {
  if (!device_answers()) return;
  const int n = sized(6000, 4000, 600);
  const Camera camera = front_camera(sized(256, 128, 64), sized(192, 96, 48));
  RenderOptions leaves = turbo_options();
  leaves.detail_px = 0;
  const StreamPool pool = device_pool(16 << 20);
  Renderer renderer = device_renderer(), reference = device_renderer();
  for (const auto& splats : {pairs(6, n), grid_splats(6, n / 2), wall(6, std::max(n, 3000)), pairs(7, n)}) {
    const Bytes bytes = in_pages(splats);
    const Scene scene = streamed_in(pool, bytes);
    const Scene all = whole(bytes);
    for (int i = 0; i < 2; ++i) {
      CAPTURE(i);
      REQUIRE(renderer.refine(scene, camera, kLong, leaves) == true);
      CHECK(is_same_picture(draw(renderer, scene, camera, leaves), draw(reference, all, camera, leaves)));
      CHECK(colours(renderer, scene, camera, leaves) == colours(reference, all, camera, leaves));
    }
  }
}

TEST_CASE("what a streamed cut has out of view takes no workspace") {
  if (!device_answers()) return;
  if (small_sizes()) return skip("RGS_TEST_SIZE is set");
  const Bytes bytes = town({.n = 400000, .sh_degree = 0});
  const StreamPool pool = device_pool(64 << 20);
  const Scene scene = streamed_in(pool, bytes);
  const Camera towards = camera_at({0, 30, 40}, {0, 0, 0});
  Renderer renderer = device_renderer();
  REQUIRE(renderer.refine(scene, towards, kLong, at_detail(0)) == true);  // all pages are resident from here on
  const Frame away = draw(renderer, scene, camera_at({0, 30, 40}, {0, 60, 80}), at_detail(0));
  const Frame all = draw(renderer, scene, towards, at_detail(0));
  CHECK(all.stats.gaussians == scene.size());
  CHECK(away.stats.bytes + scene.size() / 4 * sizeof(cuda::ScreenSplat) < all.stats.bytes);
}

TEST_CASE("a small pool: coarser pictures, evicted pages, and never more device memory than its budget") {
  if (!device_answers()) return;
  const Bytes bytes = town({.n = sized(60000, 20000, 3000)});
  const Scene all = whole(bytes);
  Renderer renderer = device_renderer(), reference = device_renderer();
  const auto views = cameras(9, sized(80, 20, 4));
  for (const std::uint64_t page_memory : {std::uint64_t{64} << 20, std::uint64_t{400} << 10}) {
    CAPTURE(page_memory);
    const StreamPool pool = device_pool(page_memory);
    {
      const Scene scene = streamed_in(pool, bytes);
      CHECK(pool.device_bytes() <= page_memory);
      double coarsest = 0;
      for (std::size_t i = 0; i < views.size(); ++i) {
        if (i % 4 == 0) require_ok(renderer.refine(scene, views[i], kLong, at_detail(0.05F)));
        const Frame frame = draw(renderer, scene, views[i], at_detail(0.05F));
        coarsest = std::max(coarsest, frame.stats.stream.detail_reached_px);
        CHECK(pool.device_bytes() <= pool.device_memory());
        if (frame.stats.stream.pages_missing == 0) {
          CHECK(is_same_picture(frame, draw(reference, all, views[i], at_detail(0.05F))));
        }
      }
      CHECK(scene.status());
      if (page_memory < std::uint64_t{1} << 20) CHECK(coarsest > 0.05);
      if (page_memory < std::uint64_t{1} << 20 && !race_sizes()) CHECK(scene.stats().bytes_evicted > 0);
    }
    CHECK(pool.device_bytes() == 0);
  }
}

TEST_CASE("what does not fit the workspace of a pool is drawn coarser, within the budget") {
  if (!device_answers() || race_sizes()) return;
  const Bytes bytes = town({.n = sized(400000, 60000, 3000), .sh_degree = 0});
  const Camera camera = resized(camera_at({0, 30, 40}, {0, 0, 0}), sized(1280, 320, 64), sized(720, 200, 48));
  const RenderOptions leaves = at_detail(0);
  std::uint64_t needed = 0, n_all = 0;
  {
    const StreamPool pool = device_pool(std::uint64_t{64} << 20);
    const Scene scene = streamed_in(pool, bytes);
    Renderer renderer = device_renderer();
    const std::uint64_t of_pages = pool.device_bytes();
    REQUIRE(renderer.refine(scene, camera, kLong, leaves) == true);
    n_all = draw(renderer, scene, camera, leaves).stats.gaussians;
    needed = pool.device_bytes() - of_pages;
  }
  // Down to less than any frame takes.
  bool is_too_small = false;
  std::uint64_t n_before = n_all;
  int n_coarser = 0;
  for (std::uint64_t workspace = needed; !is_too_small; workspace = workspace / 10 * 9) {
    CAPTURE(workspace);
    const StreamPool pool = device_pool(std::uint64_t{64} << 20, std::uint64_t{64} << 20, workspace);
    const Scene scene = streamed_in(pool, bytes);
    Renderer renderer = device_renderer();
    require_ok(renderer.refine(scene, camera, kLong, leaves));
    Frame frame = Frame::of(camera);
    for (int i = 0; i < 5; ++i) {
      const auto stats = renderer.render(scene, camera, frame.target(), leaves);
      CHECK(pool.device_bytes() <= pool.device_memory());
      if (!stats) {
        CHECK((stats.error().code == Errc::device_out_of_memory));
        is_too_small = true;
        break;
      }
      CHECK((stats->gaussians < n_all) == (stats->stream.pages_missing > 0));
      CHECK((stats->gaussians < n_all) == (stats->stream.detail_reached_px > 0));
      n_coarser += stats->gaussians < n_all;
      n_before = stats->gaussians;
    }
  }
  if (!small_sizes()) CHECK(n_coarser > 0);
  MESSAGE("a workspace of ", needed, " bytes draws all ", n_all, " Gaussians; the least one drew ", n_before);
}

TEST_CASE("two scenes in one pool, each with its own renderers, at once") {
  if (!device_answers() || race_sizes()) return;
  const Bytes bytes[2] = {town({.n = sized(40000, 10000, 3000)}), town({.n = sized(40000, 10000, 3000), .seed = 18})};
  const StreamPool pool = device_pool(1 << 20);
  const Scene scenes[2] = {streamed_in(pool, bytes[0]), streamed_in(pool, bytes[1])};
  std::atomic<int> n_failed{0};
  std::vector<std::thread> threads;
  for (unsigned t = 0; t < 4; ++t) {
    threads.emplace_back([&, t] {
      auto renderer = Renderer::create({.backend = Backend::cuda});
      for (const Camera& camera : cameras(30 + t, sized(40, 8, 2))) {
        Frame frame = Frame::of(camera);
        if (!renderer || !renderer->render(scenes[t % 2], camera, frame.target(), at_detail(0.1F))) ++n_failed;
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  CHECK(n_failed == 0);
  CHECK(scenes[0].status());
  CHECK(scenes[1].status());
  // Each alone is right afterwards.
  Renderer renderer = device_renderer(), reference = device_renderer();
  for (int k = 0; k < 2; ++k) {
    const Camera camera = cameras(77, 1).front();
    REQUIRE(renderer.refine(scenes[k], camera, kLong, at_detail(4)));
    const Frame frame = draw(renderer, scenes[k], camera, at_detail(4));
    if (frame.stats.stream.pages_missing != 0) continue;
    CHECK(is_same_picture(frame, draw(reference, whole(bytes[k]), camera, at_detail(4))));
  }
}

TEST_CASE("a pool larger than the device is refused, and leaves nothing behind") {
  if (!device_answers()) return;
  // The most that kernels can number: 170 GB of SH degree 3.
  const Bytes bytes = town({.n = 3000, .sh_degree = 3});
  const auto file = PagedFile::open(bytes);
  require_ok(file);
  constexpr std::uint64_t kMore = std::uint64_t{1} << 44;
  const auto most = detail::plan_slots(detail::SlotShape::of(*file), kMore);
  require_ok(most);
  if (device_memory() >= most->bytes) return skip("the device has room for the largest pool there is");
  const auto refused = try_streaming(bytes, std::make_shared<Script>(), {.pool = device_pool(kMore)});
  REQUIRE(!refused);
  CHECK((refused.error().code == Errc::device_out_of_memory));
  CHECK(streamed_in(device_pool(1 << 20), bytes).size() == 3000);
}

TEST_CASE("a scene whose pool has no device memory is not drawn on the device") {
  if (!device_answers()) return;
  const Bytes bytes = town({.n = 3000});
  Renderer renderer = device_renderer();
  const Scene on_host = streamed(bytes);
  Frame frame = Frame::of(front_camera(64, 48));
  CHECK(renderer.render(on_host, front_camera(64, 48), frame.target()).error().code == Errc::unavailable);
}
