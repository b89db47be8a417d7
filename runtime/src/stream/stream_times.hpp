// stream_times.hpp - where a streamed scene's threads and frames spend their time, in builds with RGS_STREAM_TIMES
// alone.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#ifdef RGS_STREAM_TIMES
#include <atomic>
#include <chrono>
#endif

namespace rgs::detail {

/// Steps of a reading thread, in turn, and of a frame before it draws.
enum class StreamStep : std::uint8_t {
  read,        ///< bytes of pages, from the source
  decode,      ///< to rows
  check,       ///< of values
  stage,       ///< to page-locked memory
  queue,       ///< queues copies and the events after them
  room,        ///< waits for page-locked memory
  wait,        ///< waits for copies, or polls them
  lock,        ///< waits for the pool's lock
  choose,      ///< under the lock: what to read
  tell,        ///< under the lock: what has arrived
  table,       ///< reads more of the table of pages
  idle,        ///< has nothing to do
  frame_lock,  ///< a frame waits for the pool's lock
  frame_cut,   ///< a frame computes its cut under the lock
};
inline constexpr std::size_t kStreamSteps = 14;
inline constexpr std::array<const char*, kStreamSteps> kStreamStepNames{
    "read", "decode", "check", "stage", "queue", "room",       "wait",
    "lock", "choose", "tell",  "table", "idle",  "frame_lock", "frame_cut"};

#ifdef RGS_STREAM_TIMES

/// Of all scenes and threads, since the program began.
struct StreamTotal {
  std::atomic<std::uint64_t> ns{0}, n{0};
};
inline std::array<StreamTotal, kStreamSteps> stream_totals;

/// Times a scope, up to its end or to next().
class StreamTimer {
 public:
  explicit StreamTimer(StreamStep step) : step_(step), began_(Clock::now()) {}
  StreamTimer(const StreamTimer&) = delete;
  StreamTimer& operator=(const StreamTimer&) = delete;
  ~StreamTimer() { add(Clock::now()); }
  void next(StreamStep step) {
    const auto now = Clock::now();
    add(now);
    step_ = step;
    began_ = now;
  }

 private:
  using Clock = std::chrono::steady_clock;
  void add(Clock::time_point now) const {
    StreamTotal& total = stream_totals[static_cast<std::size_t>(step_)];
    total.ns.fetch_add(static_cast<std::uint64_t>(std::chrono::nanoseconds(now - began_).count()),
                       std::memory_order_relaxed);
    total.n.fetch_add(1, std::memory_order_relaxed);
  }

  StreamStep step_;
  Clock::time_point began_;
};

#else

class StreamTimer {
 public:
  explicit StreamTimer(StreamStep) {}
  void next(StreamStep) {}
};

#endif

}  // namespace rgs::detail
