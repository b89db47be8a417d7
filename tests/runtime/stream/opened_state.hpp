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
  std::shared_ptr<std::atomic<detail::StreamClock::rep>> stopped =
      std::make_shared<std::atomic<detail::StreamClock::rep>>(0);
  std::shared_ptr<detail::StreamPoolState> pool;
  std::shared_ptr<Script> script = std::make_shared<Script>();
  std::shared_ptr<detail::StreamedState> state;

  explicit Opened(const Bytes& bytes, bool prefetch = false, int reads_at_once = 3, std::uint64_t most_bytes = 64 << 10,
                  std::uint64_t device_memory = 0, std::shared_ptr<detail::StreamPoolState> shared = nullptr)
      : pool(shared ? std::move(shared)
                    : std::make_shared<detail::StreamPoolState>(std::uint64_t{1} << 30, device_memory)) {
    if (pool->scenes.empty()) {
      pool->now = [at = stopped] {
        using Clock = detail::StreamClock;
        const Clock::rep standing = *at;
        return standing == 0 ? Clock::now() : Clock::time_point(Clock::duration(standing));
      };
    }
    StreamOptions options;
    options.prefetch = prefetch;
    const ByteSource::Traits traits{.reads_at_once = reads_at_once, .most_bytes = most_bytes, .gap_bytes = 4096};
    auto opened = detail::StreamedState::open(std::make_unique<ScriptedSource>(bytes, script, traits), options, pool);
    REQUIRE(opened);
    state = *std::move(opened);
  }

  detail::StreamRule rule(float detail_px) const {
    const auto settings =
        detail::resolve(detail::with_levels(at_detail(detail_px), detail_px), state->declarations, Backend::cpu);
    REQUIRE(settings);
    return {*settings, state->declarations->origin, state->declarations->z_near, detail_px};
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
  void stop(detail::StreamClock::duration ago = {}) { *stopped = (pool->now() - ago).time_since_epoch().count(); }
  /// The camera is at one position, and at another a quarter of a second later, when the clock stops.
  void move(const Camera& from, const Camera& to, float detail_px) {
    using namespace std::chrono_literals;
    stop();
    frame(from, detail_px);
    stop(-250ms);
    frame(to, detail_px);
  }
};

/// Sees the whole town.
inline Camera over() {
  return camera_at({0, 30, 60}, {0, 0, 0});
}

}  // namespace rgs::test
