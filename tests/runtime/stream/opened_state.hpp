// opened_state.hpp - a streamed scene's internals: its pool and views, refine() and frames without a renderer.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <utility>

#include "render_options.hpp"
#include "stream/streamed_state.hpp"
#include "streamed_fixture.hpp"

namespace rgs::test {

struct Opened {
  /// The time of the pool's stopped clock; 0: it runs.
  std::shared_ptr<std::atomic<pages::Time::rep>> stopped = std::make_shared<std::atomic<pages::Time::rep>>(0);
  std::shared_ptr<detail::StreamPoolState> pool;
  std::shared_ptr<Script> script = std::make_shared<Script>();
  std::shared_ptr<detail::StreamedState> state;

  explicit Opened(const Bytes& bytes, bool prefetch = false, int reads_at_once = 3, std::uint64_t most_bytes = 64 << 10,
                  std::uint64_t device_memory = 0, std::shared_ptr<detail::StreamPoolState> shared = nullptr)
      : pool(shared ? std::move(shared)
                    : std::make_shared<detail::StreamPoolState>(std::uint64_t{1} << 30, device_memory)) {
    if (pool->scenes.empty()) {
      pool->now = [at = stopped, running = pool->now] {
        const pages::Time standing(*at);
        return standing == pages::Time() ? running() : standing;
      };
    }
    OpenOptions options;
    options.prefetch = prefetch;
    const ByteSource::Traits traits{.reads_at_once = reads_at_once, .most_bytes = most_bytes, .gap_bytes = 4096};
    auto opened = detail::StreamedState::open(std::make_unique<ScriptedSource>(bytes, script, traits), options, pool);
    REQUIRE(opened);
    state = *std::move(opened);
  }

  detail::StreamRule rule(float detail_px) const {
    const auto settings = detail::resolve(detail::with_levels(at_detail(detail_px), detail_px),
                                          state->file->head().declarations(), Backend::cpu);
    REQUIRE(settings);
    return {*settings, state->file->head().declarations().origin, state->file->head().declarations().z_near, detail_px};
  }
  Result<bool> refine(const Camera& camera, float detail_px, std::uint64_t renderer = 1, double seconds = kLong) {
    return detail::refine_view(*state, renderer, camera, rule(detail_px), seconds);
  }
  detail::StreamFrame frame(const Camera& camera, float detail_px, std::uint64_t renderer = 1) {
    auto frame = detail::StreamFrame::begin(state, renderer, camera, rule(detail_px));
    REQUIRE(frame);
    return *std::move(frame);
  }
  template <class Condition>
  void await(const Condition& condition) {
    test::await([&] {
      const std::scoped_lock lock(pool->mutex);
      return condition();
    });
  }
  /// The clock stops, this long ago.
  void stop(pages::Time ago = {}) { *stopped = (pool->now() - ago).count(); }
  /// Takes all of the host's memory that is left, but so much.
  std::uint64_t use_up(std::uint64_t but = 0) {
    const std::scoped_lock lock(pool->mutex);
    const std::uint64_t n = pool->left() - but;
    CHECK(pool->take(n));
    return n;
  }
  void release(std::uint64_t bytes) {
    const std::scoped_lock lock(pool->mutex);
    pool->release(bytes);
  }
};

/// Sees the whole town.
inline Camera over() {
  return camera_at({0, 30, 60}, {0, 0, 0});
}

}  // namespace rgs::test
