// device_order_test.cpp - pages in flight to a device and in its slots: nothing is drawn before it is resident, and
// nothing is overwritten while it is drawn. The fake device works as late as allowed, or at any time.
// SPDX-License-Identifier: Apache-2.0
#include <cuda_runtime_api.h>
#include <doctest/doctest.h>

#include <array>
#include <atomic>
#include <chrono>
#include <future>
#include <optional>
#include <thread>

#include "common/copy_pieces.hpp"
#include "counted_memory.hpp"
#include "cuda/uploader.hpp"
#include "fake_cuda.hpp"
#include "opened_state.hpp"
#include "page_sections.hpp"
#include "stream/page_reader.hpp"
#include "streamed_fixture.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr FakeCuda::Pace kPaces[] = {FakeCuda::Pace::late, FakeCuda::Pace::any_time};
constexpr ByteSource::Traits kTraits{.reads_at_once = 3, .most_bytes = 64 << 10, .gap_bytes = 4096};
/// One thread, which sends many groups in turn.
constexpr ByteSource::Traits kLongRuns{.reads_at_once = 1, .most_bytes = 256 << 10, .gap_bytes = 4096};

Renderer device_renderer() {
  auto renderer = Renderer::create({.backend = Backend::cuda});
  REQUIRE(renderer);
  return *std::move(renderer);
}

/// `page_memory`: of the device; one byte more is the workspace's.
StreamPool device_pool(std::uint64_t page_memory, std::uint64_t host_memory = std::uint64_t{64} << 20) {
  auto pool = StreamPool::create({.host_memory = host_memory, .device_memory = page_memory + 1, .device_workspace = 1});
  REQUIRE(pool);
  return *std::move(pool);
}

/// A decoded page of a file.
struct OnePage {
  OnePage(const PagedFile& file, std::uint32_t page) : memory(file.decoded_bytes(page)) {
    const auto decoded = PageDecoder(file).decode(page, file.bytes(page), memory);
    REQUIRE(decoded);
    rows = *decoded;
  }

  std::vector<std::byte> memory;
  PageRows rows;
};

std::uint32_t smallest_page(const PagedFile& file) {
  const auto smallest = std::ranges::min_element(file.pages(), {}, &lod::Page::count);
  return static_cast<std::uint32_t>(smallest - file.pages().begin());
}

}  // namespace

TEST_CASE("on a device, too, a complete picture equals the whole file's, byte for byte, in every profile") {
  for (const FakeCuda::Pace pace : kPaces) {
    for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
      for (const int sh_degree : {0, 3}) {
        CAPTURE(static_cast<int>(pace));
        CAPTURE(static_cast<int>(profile));
        CAPTURE(sh_degree);
        const Bytes bytes = town({.profile = profile, .n = 5000, .sh_degree = sh_degree});
        const Scene all = whole(bytes);
        FakeCuda cuda(pace);
        {
          const StreamPool pool = device_pool(16 << 20);
          const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
          Renderer renderer = device_renderer(), reference = cpu_renderer(1);
          for (const Camera& camera : town_cameras(5, 4)) {
            for (const float detail : {2.0F, 0.0F}) {
              REQUIRE(renderer.refine(scene, camera, kLong, at_detail(detail)) == true);
              const Frame frame = draw(renderer, scene, camera, at_detail(detail));
              CHECK(is_same_picture(frame, draw(reference, all, camera, at_detail(detail))));
              CHECK(frame.stats.stream.pages_missing == 0);
              CHECK(frame.stats.pages >= 1);
            }
          }
          const StreamStats stats = scene.stats();
          CHECK(stats.bytes_uploaded == stats.bytes_decoded);
          CHECK(stats.bytes_uploaded > 0);
          CHECK(stats.bytes_evicted == 0);
        }
        CHECK(cuda.n_faults == 0);
        CHECK(cuda.device_bytes == 0);
        CHECK(cuda.pinned_bytes == 0);
      }
    }
  }
}

TEST_CASE("frames of resident pages while others come and go: no page in flight is drawn") {
  const Bytes bytes = town({.n = 30000});
  for (const FakeCuda::Pace pace : kPaces) {
    for (const std::uint64_t device_memory : {std::uint64_t{120} << 10, std::uint64_t{400} << 10}) {
      CAPTURE(static_cast<int>(pace));
      CAPTURE(device_memory);
      FakeCuda cuda(pace, device_memory, 7);
      {
        const StreamPool pool = device_pool(device_memory);
        const auto script = std::make_shared<Script>();
        const Scene scene = streamed(bytes, script, {.pool = pool, .traits = kTraits});
        CHECK(pool.device_bytes() <= device_memory);
        CHECK(pool.device_bytes() == cuda.device_bytes);
        Renderer renderer = device_renderer();
        const std::vector<Camera> cameras = town_cameras(11, 60);
        double coarsest = 0;
        for (std::size_t i = 0; i < cameras.size(); ++i) {
          if (i % 5 == 0) {
            const auto complete = renderer.refine(scene, cameras[i], kLong, at_detail(0.05F));
            REQUIRE(complete);
          }
          const Frame frame = draw(renderer, scene, cameras[i], at_detail(0.05F));
          CHECK((frame.stats.stream.pages_missing > 0 || frame.stats.stream.detail_reached_px <= 0.05));
          coarsest = std::max(coarsest, frame.stats.stream.detail_reached_px);
        }
        CHECK(coarsest > 0.05);  // the pool is too small for these views
        CHECK(scene.stats().bytes_evicted > 0);
        CHECK(scene.status());
      }
      CHECK(cuda.n_faults == 0);
      CHECK(cuda.most_device_bytes <= device_memory);
      CHECK(cuda.n_allocations == 1);  // once, not page by page
      CHECK(cuda.device_bytes == 0);
    }
  }
}

TEST_CASE("pages and workspaces together stay within a device's budget, and what does not fit is drawn coarser") {
  const Bytes bytes = town({.n = 30000});
  const std::vector<Camera> cameras = town_cameras(12, 12);
  // Enough for all; half of it for the workspace.
  for (const std::uint64_t device_memory : {std::uint64_t{64} << 20, std::uint64_t{6} << 20, std::uint64_t{3} << 20}) {
    CAPTURE(device_memory);
    const bool is_enough = device_memory == std::uint64_t{64} << 20;
    FakeCuda cuda(FakeCuda::Pace::late);
    cuda.workspace_bytes = 250;
    {
      const auto pool = StreamPool::create({.device_memory = device_memory});
      REQUIRE(pool);
      const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = *pool, .traits = kTraits});
      Renderer one = device_renderer(), two = device_renderer();
      int n_coarser = 0, n_in_a_row = 0;
      std::uint64_t most = 0;
      for (const Camera& camera : cameras) {
        for (const float detail : {0.05F, 0.0F}) {
          const auto complete = one.refine(scene, camera, kLong, at_detail(detail));
          REQUIRE(complete);
          const Frame frame = draw(one, scene, camera, at_detail(detail));
          const StreamStats& stats = frame.stats.stream;
          CHECK((stats.pages_missing > 0) == (stats.detail_reached_px > static_cast<double>(detail)));
          n_coarser += stats.pages_missing > 0;
          CHECK(250 * frame.stats.gaussians <= device_memory / 2);
          most = std::max(most, frame.stats.gaussians);
          CHECK(pool->device_bytes() == cuda.device_bytes);
          // The next frames of the view fit at once.
          const int n_unfit = cuda.n_unfit;
          for (int i = 0; i < 3; ++i) draw(one, scene, camera, at_detail(detail));
          n_in_a_row += cuda.n_unfit - n_unfit;
        }
      }
      CHECK((n_coarser == 0) == is_enough);
      CHECK((cuda.n_unfit == 0) == is_enough);
      CHECK(n_in_a_row == 0);
      // Most of the workspace is used.
      if (!is_enough) CHECK(250 * most > device_memory / 2 * 6 / 10);
      // Another renderer has as much, once pages have come to rest.
      for (Renderer* each : {&one, &two}) REQUIRE(each->refine(scene, cameras[0], kLong, at_detail(0)));
      const Frame frame = draw(one, scene, cameras[0], at_detail(0)), same = draw(two, scene, cameras[0], at_detail(0));
      CHECK(same.stats.gaussians > frame.stats.gaussians / 2);
      CHECK(pool->device_bytes() == cuda.device_bytes);
    }
    CHECK(cuda.most_device_bytes <= device_memory);
    CHECK(cuda.device_bytes == 0);
    CHECK(cuda.n_faults == 0);
  }
  for (const std::uint64_t workspace : {std::uint64_t{1} << 20, std::uint64_t{1} << 21})
    CHECK(StreamPool::create({.device_memory = 1 << 20, .device_workspace = workspace}).error().code ==
          Errc::bad_argument);
}

TEST_CASE("a pool smaller than a view gives a coarser picture, and the same one again") {
  const Bytes bytes = town({.n = 30000});
  FakeCuda cuda(FakeCuda::Pace::late);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  double finer = -1;
  for (const std::uint64_t device_memory :
       {std::uint64_t{8} << 20, std::uint64_t{300} << 10, std::uint64_t{60} << 10}) {
    CAPTURE(device_memory);
    const StreamPool pool = device_pool(device_memory);
    const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
    Renderer renderer = device_renderer();
    const auto complete = renderer.refine(scene, camera, kLong, at_detail(0));
    REQUIRE(complete);
    CHECK(*complete == (device_memory == std::uint64_t{8} << 20));
    const Frame frame = draw(renderer, scene, camera, at_detail(0));
    CHECK(frame.stats.stream.detail_reached_px > finer);
    finer = frame.stats.stream.detail_reached_px;
    CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0)), frame));
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a camera that looks away from all pages draws none") {
  const Bytes bytes = town({.n = 30000});
  FakeCuda cuda(FakeCuda::Pace::late);
  const StreamPool pool = device_pool(std::uint64_t{8} << 20);
  const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
  Renderer renderer = device_renderer();
  const Camera away = camera_at({0, 12, 9000}, {0, 12, 9999});
  CHECK(draw(renderer, scene, away, at_detail(0)).stats.gaussians == 0);
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("two scenes share a pool's slots, and the last one frees the memory") {
  const Bytes bytes = town({.n = 20000}), others = town({.n = 20000, .seed = 18}),
              unlike = town({.n = 3000, .sh_degree = 2});
  for (const FakeCuda::Pace pace : kPaces) {
    FakeCuda cuda(pace);
    {
      const StreamPool pool = device_pool(1800 << 10);
      std::optional<Scene> one = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
      const Scene two = streamed(others, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
      const auto refused = try_streaming(unlike, std::make_shared<Script>(), {.pool = pool});
      REQUIRE(!refused);
      CHECK(refused.error().code == Errc::bad_argument);
      const Scene all_one = whole(bytes), all_two = whole(others);
      Renderer a = device_renderer(), b = device_renderer(), reference = cpu_renderer(1);
      const Camera camera = camera_at({12, 2, 12}, {30, 0, 30});
      for (int i = 0; i < 4; ++i) {
        const bool is_first = i % 2 == 0;
        const Scene& scene = is_first ? *one : two;
        Renderer& renderer = is_first ? a : b;
        REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0.1F)) == true);
        CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0.1F)),
                              draw(reference, is_first ? all_one : all_two, camera, at_detail(0.1F))));
      }
      CHECK(cuda.n_allocations == 1);
      one.reset();
      CHECK(pool.device_bytes() == cuda.device_bytes);
      // The second scene takes over the first one's slots: its pages fill more than half of the pool.
      const Camera over = camera_at({0, 30, 40}, {0, 0, 0});
      CHECK(b.refine(two, over, kLong, at_detail(0)) == true);
      CHECK(two.stats().pages_resident * 5504 > pool.device_bytes() / 2);
    }
    CHECK(cuda.n_faults == 0);
    CHECK(cuda.device_bytes == 0);
    CHECK(cuda.pinned_bytes == 0);
  }
}

TEST_CASE("one scene serves several renderers at once on a device") {
  const Bytes bytes = town({.n = 20000});
  for (const FakeCuda::Pace pace : kPaces) {
    CAPTURE(static_cast<int>(pace));
    FakeCuda cuda(pace, std::uint64_t{1} << 30, 3);
    {
      const StreamPool pool = device_pool(400 << 10);
      const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
      std::atomic<int> n_failed{0};
      std::vector<std::thread> threads;
      for (unsigned t = 0; t < 3; ++t) {
        threads.emplace_back([&, t, copy = scene] {
          auto renderer = Renderer::create({.backend = Backend::cuda});
          for (const Camera& camera : town_cameras(20 + t, 30)) {
            Frame frame = Frame::of(camera);
            if (!renderer || !renderer->refine(copy, camera, kLong, at_detail(0.1F)) ||
                !renderer->render(copy, camera, frame.target(), at_detail(0.1F)))
              ++n_failed;
          }
        });
      }
      for (std::thread& thread : threads) thread.join();
      CHECK(n_failed == 0);
      CHECK(scene.stats().bytes_evicted > 0);
    }
    CHECK(cuda.n_faults == 0);
  }
}

TEST_CASE("a pool belongs to the device that was current for its first scene, and leaves the caller's device alone") {
  const Bytes bytes = town(), others = town({.seed = 18});
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  FakeCuda cuda(FakeCuda::Pace::any_time);
  int device = -1;
  const auto current = [&] {
    REQUIRE(cudaGetDevice(&device) == cudaSuccess);
    return device;
  };
  {
    Renderer renderer = device_renderer();
    const StreamPool pool = device_pool(8 << 20);
    REQUIRE(cudaSetDevice(1) == cudaSuccess);
    std::optional<Scene> one = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
    CHECK(current() == 1);
    CHECK(cuda.n_on_second == 1);
    // The caller now uses another device.
    REQUIRE(cudaSetDevice(0) == cudaSuccess);
    CHECK(renderer.refine(*one, camera, kLong, at_detail(0.5F)) == true);
    CHECK(current() == 0);
    std::optional<Scene> two = streamed(others, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
    CHECK(current() == 0);
    const int n_set = cuda.n_set_device;
    CHECK(renderer.refine(*two, camera, kLong, at_detail(0.5F)) == true);
    CHECK(renderer.refine(*one, camera, kLong, at_detail(0)) == true);
    CHECK(current() == 0);
    // Threads that send pages set the device once: the first device gets no context from them.
    CHECK(cuda.n_set_device - n_set <= 2 * kTraits.reads_at_once);
    CHECK(one->stats().pages_resident + two->stats().pages_resident > 50);
    one.reset();
    two.reset();
    CHECK(current() == 0);
    CHECK(cuda.device_bytes == 0);
    CHECK(cuda.n_allocations == 1);
  }
  CHECK(cuda.n_faults == 0);
  CHECK(cuda.pinned_bytes == 0);
}

TEST_CASE("a writer's launches use its own device, whatever the caller's") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const detail::SlotShape shape = detail::SlotShape::of(*file);
  constexpr std::uint32_t kSlots = 40;
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    REQUIRE(cudaSetDevice(1) == cudaSuccess);
    const auto slots = detail::DeviceSlots::create(shape, kSlots * shape.bytes() + 5 * 256);
    REQUIRE(slots);
    REQUIRE(cudaSetDevice(0) == cudaSuccess);
    auto writer = detail::SlotWriter::create(*slots, detail::kStagedPages);
    REQUIRE(writer);
    const OnePage page(*file, 0);
    const auto leaves_callers_device = [&] {
      int device = -1;
      return cudaGetDevice(&device) == cudaSuccess && device == 0 && cuda.n_faults == 0;
    };
    // When a page finds no room, write() sends what was staged.
    for (std::uint32_t slot = 0; cuda.n_batches == 0; ++slot) {
      REQUIRE(slot < kSlots);
      REQUIRE(writer->write(page.rows, slot));
    }
    CHECK(leaves_callers_device());
    REQUIRE(writer->send());
    CHECK(cuda.n_batches == 2);
    CHECK(leaves_callers_device());
    REQUIRE(writer->finish());
    REQUIRE(writer->write(page.rows, 0));
    REQUIRE(writer->finish());
    CHECK(cuda.n_batches == 3);
    CHECK(leaves_callers_device());
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a device without code in the build is named when a pool's first scene opens") {
  const Bytes bytes = town();
  FakeCuda cuda(FakeCuda::Pace::late);
  cuda.device_without_code = 1;
  const StreamPool pool = device_pool(8 << 20);
  REQUIRE(cudaSetDevice(1) == cudaSuccess);
  const auto refused = try_streaming(bytes, std::make_shared<Script>(), {.pool = pool});
  REQUIRE(!refused);
  CHECK(refused.error().code == Errc::unavailable);
  CHECK(cuda.n_allocations == 0);
  CHECK(pool.host_bytes() == 0);
  REQUIRE(cudaSetDevice(0) == cudaSuccess);
  CHECK(try_streaming(bytes, std::make_shared<Script>(), {.pool = pool}));
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a page that only a frame in flight leaves no room for waits for it, on the host and on a device") {
  const Bytes bytes = town({.n = 60000, .sh_degree = 0, .page_chunks = 1});
  for (const std::uint64_t device_memory : {std::uint64_t{0}, std::uint64_t{8} << 20}) {
    CAPTURE(device_memory);
    FakeCuda cuda(FakeCuda::Pace::late);
    {
      Opened opened(bytes, false, 3, 64 << 10, device_memory);
      detail::StreamPoolState& pool = *opened.pool;
      float coarse = 4096;
      for (; opened.frame(over(), coarse, 1).n_pages() < 60; coarse /= 1.5F)
        REQUIRE(opened.refine(over(), coarse, 1) == true);
      REQUIRE(opened.refine(over(), coarse, 1) == true);
      std::optional<detail::StreamFrame> held = opened.frame(over(), coarse, 1);
      {
        // Fills the rest, except for another view's host memory.
        const std::scoped_lock lock(pool.mutex);
        CHECK(
            pool.take_for_pages(pool.scheduler->left() - (pool.is_on_device() ? 0 : opened.state->least_view_bytes())));
      }
      // Close to the ground the view has fewer pages, and a larger error.
      const Camera near = camera_at({0, 1, 0}, {10, 1, 0});
      float detail = 1024;
      while (opened.frame(near, detail, 2).cut().missing == 0) {
        detail /= 1.2F;
        REQUIRE(detail > 1e-3F);
      }
      auto complete = std::async(std::launch::async, [&] { return opened.refine(near, detail, 2); });
      const auto is_over = [&] { return complete.wait_for(std::chrono::seconds(0)) == std::future_status::ready; };
      const detail::StreamedState& s = *opened.state;
      opened.await([&] {
        const bool waits = pool.scheduler->is_busy(s.views.back()->id) && !pool.scheduler->is_reading(s.id);
        return waits || is_over();
      });
      CHECK(!is_over());
      held.reset();
      CHECK(complete.get() == true);
      CHECK(opened.state->stats.bytes_evicted > 0);
    }
    CHECK(cuda.n_faults == 0);
    CHECK(cuda.device_bytes == 0);
  }
}

TEST_CASE("a failed copy is repeated, a damaged page is not, and its slot is reused") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  for (const FakeCuda::Pace pace : kPaces) {
    CAPTURE(static_cast<int>(pace));
    FakeCuda cuda(pace);
    {
      // The first one, and some from groups that precede others.
      int most_sent = 0;
      for (const int n_before : {0, 12, 33, 70, 120}) {
        CAPTURE(n_before);
        const Scene scene =
            streamed(bytes, std::make_shared<Script>(), {.pool = device_pool(8 << 20), .traits = kLongRuns});
        cuda.passes_next = n_before;
        cuda.fails_next = 1;
        Renderer renderer = device_renderer(), reference = cpu_renderer(1);
        CHECK(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
        CHECK(cuda.fails_next == 0);
        most_sent = std::max<int>(most_sent, cuda.n_sent_at_failure);
        CHECK(scene.status());
        CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0)), draw(reference, all, camera, at_detail(0))));
      }
      if (pace == FakeCuda::Pace::late) CHECK(most_sent >= 1);  // and not reported yet
      const StreamPool pool = device_pool(8 << 20);
      Renderer renderer = device_renderer();

      // The last of its siblings: the others are in flight when it is found.
      const lod::Page& above = file->pages()[file->pages()[file->n_pages() - file->n_pages() / 3].parent];
      REQUIRE(above.n_children > 1);
      const StoredPage& stored = file->stored(above.first_child + above.n_children - 1);
      const auto script = std::make_shared<Script>();
      script->flip_from = stored.offset + 40, script->flip_to = stored.offset + 41;
      const Scene damaged = streamed(bytes, script, {.pool = pool, .traits = kTraits});
      CHECK(!renderer.refine(damaged, camera, kLong, at_detail(0)));
      CHECK(draw(renderer, damaged, camera, at_detail(0)).stats.stream.pages_missing > 0);
      CHECK(damaged.status().error().code == Errc::checksum_mismatch);
    }
    CHECK(cuda.n_faults == 0);
    CHECK(cuda.device_bytes == 0);
  }
}

TEST_CASE("after a failed event query or wait, pages not known to be resident are sent again") {
  const Bytes bytes = town({.n = 30000});
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
  for (const bool is_asked : {true, false}) {
    CAPTURE(is_asked);
    FakeCuda cuda(FakeCuda::Pace::late);
    const Scene scene =
        streamed(bytes, std::make_shared<Script>(), {.pool = device_pool(8 << 20), .traits = kLongRuns});
    // The first run has one group.
    cuda.sync_passes_next = 1;
    (is_asked ? cuda.query_fails_next : cuda.sync_fails_next) = 1;
    Renderer renderer = device_renderer(), reference = cpu_renderer(1);
    CHECK(renderer.refine(scene, camera, kLong, at_detail(0.02F)) == true);
    CHECK(cuda.query_fails_next + cuda.sync_fails_next == 0);
    if (!is_asked) REQUIRE(cuda.n_sent_at_failure > 1);
    CHECK(cuda.n_faults == 0);
    CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0.02F)),
                          draw(reference, all, camera, at_detail(0.02F))));
  }
}

TEST_CASE("a writer keeps what is in flight, waits without room, and every byte gets to its slot") {
  for (const int sh_degree : {0, 3}) {
    const Bytes bytes = town({.n = 20000, .sh_degree = sh_degree});
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const detail::SlotShape shape = detail::SlotShape::of(*file);
    const std::uint32_t n = file->n_pages();
    REQUIRE(n > 40);
    for (const FakeCuda::Pace pace : kPaces) {
      for (const std::uint32_t n_staged : {detail::kLeastStagedPages, 3u, detail::kStagedPages}) {
        for (const std::uint32_t n_together : {1u, 3u, 40u}) {
          CAPTURE(sh_degree);
          CAPTURE(static_cast<int>(pace));
          CAPTURE(n_staged);
          CAPTURE(n_together);
          FakeCuda cuda(pace);
          {
            const auto slots = detail::DeviceSlots::create(shape, (n + 1) * shape.bytes() + 5 * 256);
            REQUIRE(slots);
            auto writer = detail::SlotWriter::create(*slots, n_staged);
            REQUIRE(writer);
            CHECK(cuda.pinned_bytes == detail::staging_bytes(shape, n_staged));
            PageDecoder decoder(*file);
            std::vector<std::byte> memory(file->largest_decoded_bytes()), expected(detail::staging_bytes(shape, 1));
            const auto rows_of = [&](std::uint32_t page) {
              auto rows = decoder.decode(page, file->bytes(page), std::span(memory).first(file->decoded_bytes(page)));
              REQUIRE(rows);
              return *rows;
            };
            detail::SlotWriter::Ticket last = 0;
            for (std::uint32_t page = 0; page < n; ++page) {
              REQUIRE(writer->write(rows_of(page), n - 1 - page));
              std::ranges::fill(memory, std::byte{0x5A});  // nobody reads it any more
              if (page % n_together != 0) continue;
              const auto ticket = writer->send();
              REQUIRE(ticket);
              CHECK(*ticket > last);
              last = *ticket;
              if (pace == FakeCuda::Pace::late) CHECK(writer->is_done(last) == false);
            }
            REQUIRE(writer->finish());
            CHECK(cuda.n_pending() == 0);
            CHECK(writer->is_done(last) == true);
            CHECK(cuda.n_batches < static_cast<int>(n) + 1);
            if (n_together == 1) CHECK(cuda.n_batches == static_cast<int>(n));
            for (std::uint32_t page = 0; page < n; ++page) {
              const PageRows rows = rows_of(page);
              std::array<std::byte*, 5> to;
              std::byte* at = expected.data();
              for (std::size_t k = 0; k < to.size(); ++k) {
                to[k] = at;
                at += detail::staged_section_bytes(shape.section_bytes()[k]);
              }
              const std::uint32_t slot = n - 1 - page;
              detail::write_page_sections(rows, shape.chunk_size, std::uint64_t{slot} * shape.page_chunks, to);
              const auto n_rows = detail::section_rows(rows.n, rows.steps.size() / kStepSetBytes, shape.chunk_size);
              for (std::size_t k = 0; k < to.size(); ++k) {
                const std::uint64_t size = n_rows[k] * detail::section_row_bytes(sh_degree)[k];
                REQUIRE(std::equal(to[k], to[k] + size, (*slots)->at(k, slot)));
              }
            }
          }
          CHECK(cuda.n_faults == 0);
          CHECK(cuda.pinned_bytes == 0);
          CHECK(cuda.device_bytes == 0);
        }
      }
    }
  }
}

TEST_CASE("small pages, of which a ring holds many: no more are sent together than one call has room for") {
  const Bytes bytes = town({.n = 20000});
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const detail::SlotShape shape = detail::SlotShape::of(*file);
  constexpr std::uint32_t kSlots = 60;
  const std::uint32_t least = smallest_page(*file);
  REQUIRE(file->pages()[least].count <= shape.chunk_size);
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    const auto slots = detail::DeviceSlots::create(shape, kSlots * shape.bytes() + 5 * 256);
    REQUIRE(slots);
    auto writer = detail::SlotWriter::create(*slots, detail::kStagedPages);
    REQUIRE(writer);
    const OnePage page(*file, least);
    for (std::uint32_t slot = 0; slot < kSlots; ++slot) REQUIRE(writer->write(page.rows, slot));
    CHECK(cuda.n_pending() > detail::kStagedPages * 5);  // more than would fit if they were large
    REQUIRE(writer->finish());
    for (std::uint32_t slot = 0; slot < kSlots; ++slot)
      CHECK(std::equal(page.rows.means.begin(), page.rows.means.end(), (*slots)->at(0, slot)));
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a sent page is resident once the device has copied it, and asking does not wait") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const detail::SlotShape shape = detail::SlotShape::of(*file);
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    const auto slots = detail::DeviceSlots::create(shape, 4 * shape.bytes() + 5 * 256);
    REQUIRE(slots);
    auto writer = detail::SlotWriter::create(*slots, detail::kStagedPages);
    REQUIRE(writer);
    const OnePage page(*file, 0);
    REQUIRE(writer->write(page.rows, 1));
    CHECK(cuda.n_pending() == 0);  // staged, but not sent
    const auto ticket = writer->send();
    REQUIRE(ticket);
    CHECK(cuda.n_pending() == 5);
    CHECK(cuda.n_batches == 1);
    CHECK(writer->is_done(*ticket) == false);
    CHECK(writer->is_done(*ticket) == false);
    CHECK(cuda.n_pending() == 5);
    const auto again = writer->send();  // nothing more
    REQUIRE(again);
    CHECK(*again == *ticket);
    CHECK(cuda.n_batches == 1);
    REQUIRE(writer->finish());
    CHECK(cuda.n_pending() == 0);
    CHECK(writer->is_done(*ticket) == true);
    // A refused copy concerns this send() alone.
    REQUIRE(writer->write(page.rows, 2));
    cuda.passes_next = 2;
    cuda.fails_next = 1;
    const auto refused = writer->send();
    REQUIRE(!refused);
    CHECK(refused.error().code == Errc::device_failed);
    CHECK(cuda.n_pending() == 2);
    CHECK(writer->finish());
    CHECK(cuda.n_pending() == 0);
    REQUIRE(writer->write(page.rows, 2));
    REQUIRE(writer->finish());
    CHECK(cuda.is_allocated((*slots)->at(0, 2), 12));
    CHECK(std::equal((*slots)->at(0, 2), (*slots)->at(0, 2) + page.rows.means.size(), page.rows.means.data()));
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("sendings of a ring end in any order, and their memory is free in the order of tickets") {
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    void* to = nullptr;
    REQUIRE(cudaMalloc(&to, 3 * 256) == cudaSuccess);
    detail::OwnedStream one, other;
    detail::Uploader ring;
    REQUIRE(one.create());
    REQUIRE(other.create());
    REQUIRE(ring.create(3 * 256, 3));
    std::vector<detail::Uploader::Place> places;
    while (const auto place = ring.take(256)) places.push_back(*place);
    REQUIRE(places.size() == 3);
    const auto send = [&](std::size_t k, const detail::OwnedStream& stream) {
      cuda::Pieces pieces;
      pieces.add(static_cast<std::byte*>(to) + 256 * k, places[k].memory, 256);
      REQUIRE(cuda::launch_copy_pieces(pieces, stream.get()));
      REQUIRE(ring.send(places[k].ticket, stream.get()));
    };
    send(2, other);
    CHECK_FALSE(ring.can_wait());  // the oldest is not sent
    REQUIRE(ring.release(true));
    CHECK_FALSE(ring.is_done(places[2].ticket));
    CHECK_FALSE(ring.take(256));
    send(0, one);
    REQUIRE(ring.release(true));
    CHECK(ring.is_done(places[0].ticket));
    CHECK_FALSE(ring.is_done(places[1].ticket));
    const auto again = ring.take(256);
    REQUIRE(again);
    CHECK(again->memory == places[0].memory);
    send(1, one);
    while (!ring.is_done(places[2].ticket)) REQUIRE(ring.release(true));
    CHECK(cuda.n_pending() == 0);
    CHECK_FALSE(ring.is_done(again->ticket));
    cudaFree(to);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("the number of sends in flight is limited: one more waits for the first") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const detail::SlotShape shape = detail::SlotShape::of(*file);
  constexpr std::uint32_t kMostSent = 16;
  const std::uint32_t least = smallest_page(*file);
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    const auto slots = detail::DeviceSlots::create(shape, (kMostSent + 1) * shape.bytes() + 5 * 256);
    REQUIRE(slots);
    auto writer = detail::SlotWriter::create(*slots, kMostSent + 1);  // the ring has room for more
    REQUIRE(writer);
    const OnePage page(*file, least);
    std::vector<detail::SlotWriter::Ticket> tickets;
    for (std::uint32_t slot = 0; slot <= kMostSent; ++slot) {
      if (slot == kMostSent) CHECK(writer->is_done(tickets[0]) == false);
      REQUIRE(writer->write(page.rows, slot));
      const auto ticket = writer->send();
      REQUIRE(ticket);
      tickets.push_back(*ticket);
    }
    CHECK(cuda.n_pending() == kMostSent * 5);
    CHECK(writer->is_done(tickets[0]) == true);
    CHECK(writer->is_done(tickets[1]) == false);
    REQUIRE(writer->finish());
    for (std::uint32_t slot = 0; slot <= kMostSent; ++slot)
      CHECK(std::equal(page.rows.means.begin(), page.rows.means.end(), (*slots)->at(0, slot)));
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("arrived groups of a run are drawn while the last one is still being read") {
  const Bytes bytes = town({.n = 30000});
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  // The last page of the third level arrives damaged, and is read again alone.
  const std::vector<lod::Page>& pages = file->pages();
  const lod::Page& above = pages[pages[0].first_child + pages[0].n_children - 1];
  REQUIRE(above.n_children > 0);
  const StoredPage& last = file->stored(above.first_child + above.n_children - 1);
  const auto script = std::make_shared<Script>();
  script->flip_from = last.offset + 40, script->flip_to = last.offset + 41, script->flips_once = true;
  FakeCuda cuda(FakeCuda::Pace::at_once);
  {
    const Scene scene = streamed(bytes, script, {.pool = device_pool(8 << 20), .traits = kLongRuns});
    script->shut_from = last.offset, script->shut_to = last.offset + last.stored_bytes;
    script->is_shut = true;
    Renderer renderer = device_renderer();
    auto complete = std::async(std::launch::async, [&] { return renderer.refine(scene, over(), kLong, at_detail(0)); });
    const auto waits_at = [&](int n_flipped) {
      test::await([&] {
        const std::scoped_lock lock(script->mutex);
        return script->n_held == 1 && script->n_allowed == 0 && script->n_flipped == n_flipped;
      });
    };
    waits_at(0);
    const std::uint64_t before = scene.stats().bytes_uploaded;
    script->let_one_go();
    waits_at(1);
    CHECK(scene.stats().bytes_uploaded > before);
    script->open_gate();
    CHECK(complete.get() == true);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("each group is sent with one call, and drawn while its thread decodes on") {
  const Bytes bytes = town({.n = 60000});
  FakeCuda cuda(FakeCuda::Pace::any_time);
  {
    const Scene scene =
        streamed(bytes, std::make_shared<Script>(), {.pool = device_pool(8 << 20), .traits = kLongRuns});
    Renderer renderer = device_renderer();
    CHECK(renderer.refine(scene, camera_at({0, 30, 40}, {0, 0, 0}), kLong, at_detail(0)) == true);
    // Pages have siblings.
    CHECK(static_cast<std::uint64_t>(cuda.n_batches) * 3 < scene.stats().pages_resident * 2);
    CHECK(cuda.n_seen_done + cuda.n_seen_at_work > 0);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("pages that many threads send at once, in rings of any size, equal the file's") {
  const Bytes bytes = town({.n = 20000, .sh_degree = 1});
  const Scene all = whole(bytes);
  const Camera camera = camera_at({0, 30, 40}, {0, 0, 0});
  Renderer reference = cpu_renderer(1);
  const Frame expected = draw(reference, all, camera, at_detail(0));
  for (const int reads_at_once : {16, 1}) {
    for (const std::uint64_t host_memory : {std::uint64_t{256} << 20, std::uint64_t{6} << 20}) {
      CAPTURE(reads_at_once);
      CAPTURE(host_memory);
      FakeCuda cuda(FakeCuda::Pace::any_time);
      {
        const Scene scene =
            streamed(bytes, std::make_shared<Script>(),
                     {.pool = device_pool(std::uint64_t{32} << 20, host_memory),
                      .traits = {.reads_at_once = reads_at_once, .most_bytes = 256 << 10, .gap_bytes = 4096}});
        Renderer renderer = device_renderer();
        REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
        CHECK(is_same_picture(draw(renderer, scene, camera, at_detail(0)), expected));
        CHECK(scene.stats().bytes_uploaded == scene.stats().bytes_decoded);
      }
      CHECK(cuda.n_faults == 0);
    }
  }
}

TEST_CASE("evicted pages have nothing in flight: their slots can be reused") {
  const Bytes bytes = town({.n = 500});
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  REQUIRE(file->n_levels() == 2);
  const auto script = std::make_shared<Script>();
  script->flip_from = file->stored(file->n_pages() - 1).offset + 40, script->flip_to = script->flip_from + 1;
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    const Scene scene = streamed(bytes, script, {.pool = device_pool(8 << 20), .traits = kTraits});
    Renderer renderer = device_renderer();
    CHECK(!renderer.refine(scene, camera_at({0, 30, 40}, {0, 0, 0}), kLong, at_detail(0)));
    CHECK(cuda.n_pending() == 0);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a device's lack of memory is reported with the bytes required, and nothing stays allocated") {
  const Bytes bytes = town();
  {
    // No device at all.
    const StreamPool pool = device_pool(8 << 20);
    const auto scene = try_streaming(bytes, std::make_shared<Script>(), {.pool = pool});
    REQUIRE(!scene);
    CHECK(scene.error().code == Errc::unavailable);
    CHECK(pool.host_bytes() == 0);
  }
  FakeCuda cuda(FakeCuda::Pace::late, 1 << 20);
  {
    const StreamPool pool = device_pool(100);
    CHECK(pool.device_memory() == 101);
    const auto scene = try_streaming(bytes, std::make_shared<Script>(), {.pool = pool});
    REQUIRE(!scene);
    CHECK(scene.error().code == Errc::limit_exceeded);
    CHECK(scene.error().found == 101);
    const StreamPool enough = device_pool(scene.error().expected);
    const Scene least = streamed(bytes, std::make_shared<Script>(), {.pool = enough});
    Renderer renderer = device_renderer();
    const Frame frame = draw(renderer, least, camera_at({0, 12, 30}, {0, 0, 0}));
    CHECK(frame.stats.pages == 1);  // the root
    CHECK(frame.stats.stream.pages_missing > 0);
    // A second scene has its coarsest page, too.
    const auto second = try_streaming(bytes, std::make_shared<Script>(), {.pool = enough});
    REQUIRE(!second);
    CHECK(second.error().code == Errc::limit_exceeded);
  }
  {
    const StreamPool pool = device_pool(2 << 20);  // more than the device has
    const auto scene = try_streaming(bytes, std::make_shared<Script>(), {.pool = pool});
    REQUIRE(!scene);
    CHECK(scene.error().code == Errc::device_out_of_memory);
    CHECK(pool.host_bytes() == 0);
  }
  CHECK(cuda.device_bytes == 0);
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("a scene is drawn by the renderer of its pages' device, and the other renderer says so") {
  const Bytes bytes = town({.n = 3000});
  FakeCuda cuda(FakeCuda::Pace::late);
  {
    const Scene on_device = streamed(bytes, std::make_shared<Script>(), {.pool = device_pool(1 << 20)});
    const Scene on_host = streamed(bytes);
    Renderer device = device_renderer(), host = cpu_renderer(1);
    const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
    Frame frame = Frame::of(camera);
    CHECK(device.render(on_device, camera, frame.target()));
    CHECK(host.render(on_host, camera, frame.target()));
    CHECK(device.render(on_host, camera, frame.target()).error().code == Errc::unavailable);
    CHECK(host.render(on_device, camera, frame.target()).error().code == Errc::unavailable);
    CHECK(device.refine(on_host, camera, 0).error().code == Errc::unavailable);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("several devices draw a run of the cameras each, and the first run's error is told") {
  const FakeCuda cuda(FakeCuda::Pace::at_once);
  auto renderer = Renderer::create({.devices = {1, 0, 1}});
  REQUIRE(renderer);
  const std::vector<std::vector<std::uint64_t>> drawn_by{{1, 0}, {1, 0, 1}, {1, 1, 0, 0, 1, 1, 1}};
  for (const std::vector<std::uint64_t>& expected : drawn_by) {
    const std::size_t n = expected.size();
    std::vector<Camera> cameras(n, camera_at({0, 12, 30}, {0, 0, 0}, 4, 2));
    for (std::size_t i = 0; i < n; ++i) cameras[i].fx = static_cast<double>(100 + i);
    std::vector<std::uint8_t> codes(n * 24);
    const auto stats = renderer->render_all(Scene(), cameras, {.codes = codes.data()});
    REQUIRE(stats);
    REQUIRE(stats->size() == n);
    for (std::size_t i = 0; i < n; ++i) {
      CHECK((*stats)[i].gaussians == expected[i]);
      CHECK(codes[24 * i] == 100 + i);
    }
    cameras[n / 2].name = cameras.back().name = "fails";
    const auto refused = renderer->render_all(Scene(), cameras, {.codes = codes.data()});
    REQUIRE_FALSE(refused);
    CHECK(refused.error().found == 100 + n / 2);
    CHECK(renderer->render_all(Scene(), cameras, {.on_device = true}).error().code == Errc::bad_argument);
  }
}

TEST_CASE("a pool with a device holds no more host memory than its budget, counting every allocation") {
  if (!counts_memory()) return;
  // Threads, and copies in the fake device's queues.
  constexpr std::int64_t kBeside = 96 << 10;
  const std::vector<Camera> views = town_cameras(31, 12);
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const Bytes bytes = town({.profile = profile, .n = 40000, .sh_degree = 3});
    const std::uint64_t device_memory = 2 << 20;
    FakeCuda cuda(FakeCuda::Pace::late);
    // The minimum to open, and room for views' lists.
    std::uint64_t least = 1;
    for (;;) {
      const auto scene = try_streaming(bytes, std::make_shared<Script>(),
                                       {.pool = device_pool(device_memory, least), .traits = kTraits});
      if (scene) break;
      REQUIRE(scene.error().code == Errc::limit_exceeded);
      REQUIRE(scene.error().expected > least);
      least = scene.error().expected;
    }
    for (const std::uint64_t host_memory : {least, least + (256 << 10)}) {
      CAPTURE(static_cast<int>(profile));
      CAPTURE(host_memory);
      const StreamPool pool = device_pool(device_memory, host_memory);
      const std::int64_t before = live_bytes();
      reset_peak_bytes();
      {
        const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
        Renderer renderer = device_renderer();
        for (const Camera& camera : views) REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0.02F)));
        CHECK(scene.stats().bytes_evicted > 0);
        CHECK(pool.host_bytes() <= host_memory);
        const auto of_device = static_cast<std::int64_t>(cuda.most_device_bytes);
        CHECK(of_device <= static_cast<std::int64_t>(device_memory));
        CHECK(peak_bytes() - before - of_device <= static_cast<std::int64_t>(host_memory) + kBeside);
        MESSAGE("budget ", host_memory, ", counted by the pool ", pool.host_bytes(), ", held at most ",
                peak_bytes() - before - of_device);
      }
      CHECK(live_bytes() - before <= kBeside);
    }
  }
}

TEST_CASE("a single thread releases page-locked memory first, and reads as much as ever") {
  const Bytes bytes = town();
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  const std::uint64_t page = detail::staging_bytes(detail::SlotShape::of(*file), 1);
  constexpr std::uint64_t kReadersShare = 8;  // of the budget, for threads
  FakeCuda cuda(FakeCuda::Pace::late);
  for (const std::uint32_t n_staged : {detail::kStagedPages, detail::kStagedPages / 2, detail::kLeastStagedPages}) {
    CAPTURE(n_staged);
    const std::uint64_t reader = detail::PageReader::bytes(*file, kLongRuns.most_bytes, nullptr, 0) + n_staged * page;
    const Opened opened(bytes, false, 1, kLongRuns.most_bytes, 0,
                        std::make_shared<detail::StreamPoolState>(kReadersShare * reader, 8 << 20));
    CHECK(cuda.pinned_bytes == n_staged * page);
    CHECK(opened.state->traits.most_bytes == kLongRuns.most_bytes);
  }
  CHECK(cuda.n_faults == 0);
}

TEST_CASE("page-locked memory and tables count towards the host's budget") {
  const Bytes bytes = town({.n = 30000});
  FakeCuda cuda(FakeCuda::Pace::any_time);
  {
    const std::uint64_t host_memory = 2 << 20;
    const StreamPool pool = device_pool(8 << 20, host_memory);
    const Scene scene = streamed(bytes, std::make_shared<Script>(), {.pool = pool, .traits = kTraits});
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const std::uint64_t page = detail::staging_bytes(detail::SlotShape::of(*file), 1);
    CHECK(cuda.pinned_bytes >= detail::kLeastStagedPages * page);
    CHECK(cuda.pinned_bytes <= kTraits.reads_at_once * detail::kStagedPages * page);
    {
      // With room for it each thread has the maximum.
      const std::uint64_t before = cuda.pinned_bytes;
      const Scene roomy = streamed(bytes, std::make_shared<Script>(),
                                   {.pool = device_pool(8 << 20, std::uint64_t{1} << 30), .traits = kTraits});
      CHECK(cuda.pinned_bytes - before == kTraits.reads_at_once * detail::kStagedPages * page);
    }
    // Without a device the scene's tables and threads take less, at least by the page-locked memory.
    const auto host_pool = StreamPool::create({.host_memory = host_memory});
    REQUIRE(host_pool);
    const Scene on_host = streamed(bytes, std::make_shared<Script>(), {.pool = *host_pool, .traits = kTraits});
    const std::uint64_t root = on_host.stats().bytes_decoded * 2;  // at most: FP32 in place of the stored form
    CHECK(pool.host_bytes() + root >= host_pool->host_bytes() + cuda.pinned_bytes);
    const std::uint64_t before = pool.host_bytes();
    Renderer renderer = device_renderer();
    const Camera camera = camera_at({0, 12, 30}, {0, 0, 0});
    REQUIRE(renderer.refine(scene, camera, kLong, at_detail(0)) == true);
    CHECK(pool.host_bytes() <= host_memory);
    // Pages take none of it.
    CHECK(pool.host_bytes() - before < scene.stats().bytes_uploaded / 4);
  }
  CHECK(cuda.pinned_bytes == 0);
  CHECK(cuda.n_faults == 0);
}
