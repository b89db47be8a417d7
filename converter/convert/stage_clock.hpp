// stage_clock.hpp - times the stages of a conversion and notifies the observer.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <utility>
#include <vector>

#include "convert.hpp"

namespace rgs {

class StageClock {
 public:
  StageClock(const StageObserver& observer, std::vector<std::pair<const char*, double>>& seconds)
      : observer_(observer), seconds_(seconds) {}

  /// Ends the running stage and starts the next.
  void begin(const char* stage, std::uint64_t total, const char* unit) {
    end();
    stage_ = stage;
    start_ = std::chrono::steady_clock::now();
    observer_.begin(stage, total, unit);
  }
  void end() {
    if (stage_ == nullptr) return;
    seconds_.emplace_back(stage_, std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count());
    observer_.finish();
    stage_ = nullptr;
  }

 private:
  const StageObserver& observer_;
  std::vector<std::pair<const char*, double>>& seconds_;
  const char* stage_ = nullptr;
  std::chrono::steady_clock::time_point start_{};
};

}  // namespace rgs
