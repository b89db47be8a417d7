// work.hpp - a long call: its progress, which Python asks for, and its end.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <future>
#include <mutex>
#include <stop_token>
#include <string>
#include <thread>
#include <utility>

#include "calls.hpp"
#include "convert.hpp"

namespace rgs::python {

/// Thrown out of a progress observer when the work is cancelled; the call's reply is then an error.
struct Cancelled {};

class Work {
 public:
  /// Its stages end by Cancelled after cancel().
  StageObserver observer() {
    StageObserver observer;
    observer.begin = [this](const char* stage, std::uint64_t total, const char* unit) { begin(stage, total, unit); };
    observer.advance = [this](std::uint64_t units) {
      if (stop_.stop_requested()) throw Cancelled();
      advance(units);
    };
    observer.finish = [this] {
      const std::scoped_lock lock(mutex_);
      stage_.done = done_;
      if (open_) finished_.push_back(stage_);
      open_ = false;
    };
    return observer;
  }
  void begin(const char* stage, std::uint64_t total, const char* unit) {
    if (stop_.stop_requested()) throw Cancelled();
    const std::scoped_lock lock(mutex_);
    stage_ = {stage, total, unit, 0};
    done_ = 0;
    open_ = true;
  }
  void advance(std::uint64_t units) { done_.fetch_add(units, std::memory_order_relaxed); }
  template <class Call>
  void start(Call call) {
    std::packaged_task<std::string()> task(std::move(call));
    reply_ = task.get_future();
    std::thread(std::move(task)).detach();
  }
  /// Whether it has ended, or was not started, after so many seconds at the latest.
  bool wait(double seconds) const {
    return !reply_.valid() || reply_.wait_for(std::chrono::duration<double>(seconds)) == std::future_status::ready;
  }
  std::string reply() { return reply_.get(); }
  void cancel() { stop_.request_stop(); }
  std::stop_token stop() const { return stop_.get_token(); }

  /// [stage, done, total, unit] of those that have ended since the last call, and of the current one. total is 0 if
  /// unknown.
  Json report() {
    const std::scoped_lock lock(mutex_);
    auto stages = std::exchange(finished_, {});
    if (open_) {
      stages.push_back(stage_);
      stages.back().done = done_;
    }
    Json list = Json::array();
    for (const Stage& s : stages) list.push_back({s.name, s.done, s.total, s.unit});
    return list;
  }

 private:
  struct Stage {
    const char* name;
    std::uint64_t total;
    const char* unit;
    std::uint64_t done;
  };
  std::future<std::string> reply_;
  std::stop_source stop_;
  std::atomic<std::uint64_t> done_{0};
  std::mutex mutex_;  // of the following
  Stage stage_{"", 0, "", 0};
  bool open_ = false;
  std::deque<Stage> finished_;
};

}  // namespace rgs::python
