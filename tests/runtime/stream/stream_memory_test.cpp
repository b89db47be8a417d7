// stream_memory_test.cpp - a pool's budget against the program's memory, and long flights.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstdlib>
#include <string>

#include "counted_memory.hpp"
#include "streamed_fixture.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// A scene's memory beyond its budget: threads, and what grows neither with the file nor with a view.
constexpr std::int64_t kBeside = 64 << 10;

std::vector<Camera> flight(unsigned seed, int n) {
  Random random(seed);
  std::vector<Camera> cameras;
  glm::dvec3 eye(-25, 3, -25);
  double turn = 0;
  for (int i = 0; i < n; ++i) {
    // Onwards, with a jump now and then.
    if (i % 40 == 39) eye = {random.uniform(-30, 30), random.uniform(1, 30), random.uniform(-30, 30)};
    turn += random.uniform(-0.2, 0.25);
    eye += glm::dvec3(std::cos(turn), 0.1 * std::sin(3 * turn), std::sin(turn));
    cameras.push_back(camera_at(eye, eye + glm::dvec3(std::cos(turn), -0.2, std::sin(turn)), 64, 48));
  }
  return cameras;
}

}  // namespace

TEST_CASE("a pool never exceeds its budget, counting every allocation, on any flight") {
  if (!counts_memory()) return;
  const std::vector<Camera> cameras = flight(7, 160);
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    for (const int sh_degree : {0, 3}) {
      const Bytes bytes = town({.profile = profile, .n = 60000, .sh_degree = sh_degree});
      // An archive's tables take more while it is opened.
      const std::uint64_t base = profile == Profile::archive ? kMostArchiveMemory : 0;
      Renderer renderer = cpu_renderer();
      std::vector<Frame> frames(1, Frame::of(cameras.front()));
      {
        // The renderer's own memory has reached its size.
        const Scene all = whole(bytes);
        for (const Camera& camera : cameras) {
          for (const float detail : {0.0F, 0.02F, 0.3F, 1.0F, 4.0F, 1e9F})
            REQUIRE(renderer.render(all, camera, frames[0].target(), at_detail(detail)));
        }
      }
      for (const std::uint64_t kib : {1600u, 3000u, 6000u, 40000u}) {
        const std::uint64_t memory = base + (kib << 10);
        CAPTURE(static_cast<int>(profile));
        CAPTURE(sh_degree);
        CAPTURE(memory);
        const auto pool = StreamPool::create({.host_memory = memory});
        REQUIRE(pool);
        const auto script = std::make_shared<Script>();
        const std::int64_t before = live_bytes();
        reset_peak_bytes();
        std::uint64_t most = 0;
        {
          const Scene scene =
              streamed(bytes, script,
                       {.pool = *pool, .traits = {.reads_at_once = 3, .most_bytes = 256 << 10, .gap_bytes = 4096}});
          CHECK(peak_bytes() - before <= static_cast<std::int64_t>(memory) + kBeside);
          for (std::size_t i = 0; i < cameras.size(); ++i) {
            const RenderOptions options = at_detail(0.02F);
            if (i % 16 == 0) REQUIRE(renderer.refine(scene, cameras[i], kLong, options));
            REQUIRE(renderer.render(scene, cameras[i], frames[0].target(), options));
            most = std::max(most, pool->host_bytes());
            REQUIRE(pool->host_bytes() <= memory);
          }
          CHECK(scene.status());
          if (kib == 1600) CHECK(scene.stats().bytes_evicted > 0);
          MESSAGE("budget ", memory, ", counted by the pool ", most, ", held at most ", peak_bytes() - before,
                  ", evicted ", scene.stats().bytes_evicted, ", pages ", scene.stats().pages_resident);
        }
        CHECK(peak_bytes() - before <= static_cast<std::int64_t>(memory) + kBeside);
        CHECK(pool->host_bytes() == 0);
        CHECK(live_bytes() - before <= kBeside);
      }
    }
  }
}

TEST_CASE("a long random flight with a pool that is far too small: no growth, no error, no leak") {
  const char* const wanted = std::getenv("RGS_SOAK_FLIGHTS");
  const int n_flights = wanted == nullptr ? 6 : std::atoi(wanted);
  const Bytes bytes = town({.profile = Profile::packed, .n = 60000, .sh_degree = 1});
  const auto pool = StreamPool::create({.host_memory = 2500 << 10});
  REQUIRE(pool);
  const ByteSource::Traits traits{.reads_at_once = 2, .most_bytes = 64 << 10, .gap_bytes = 4096};
  Renderer renderer = cpu_renderer();
  std::int64_t after_first = 0;
  std::uint64_t n_frames = 0;
  for (int flown = 0; flown < n_flights; ++flown) {
    {
      // Two scenes come and go in one pool; reads of one sometimes fail.
      const auto script = std::make_shared<Script>();
      const Scene scene = streamed(bytes, script, {.pool = *pool, .traits = traits});
      const Scene other = streamed(bytes, std::make_shared<Script>(), {.pool = *pool, .traits = traits});
      script->fails_every = 501;
      for (const Camera& camera : flight(static_cast<unsigned>(80 * flown + 1), 80)) {
        const RenderOptions options = at_detail(n_frames % 7 == 0 ? 0.0F : 0.3F);
        const Frame frame = draw(renderer, scene, camera, options);
        REQUIRE(frame.stats.pages <= frame.stats.stream.pages_resident);
        draw(renderer, other, camera, options);
        if (n_frames % 20 == 0) {
          const auto complete = renderer.refine(scene, camera, kLong, options);
          if (!complete) REQUIRE(complete.error().code == Errc::read_failed);
        }
        REQUIRE(pool->host_bytes() <= pool->host_memory());
        ++n_frames;
      }
      MESSAGE(scene.stats().bytes_decoded, " bytes decoded, ", scene.stats().bytes_evicted, " evicted");
    }
    CHECK(pool->host_bytes() == 0);
    if (flown == 0) {
      // The renderer's own memory has reached its size.
      const Scene all = whole(bytes);
      for (int k = 0; k < n_flights; ++k) {
        for (const Camera& camera : flight(static_cast<unsigned>(80 * k + 1), 80)) draw(renderer, all, camera);
      }
    }
    if (flown == 0) after_first = live_bytes();
    if (counts_live_memory()) CHECK(live_bytes() <= after_first + kBeside);
  }
}
