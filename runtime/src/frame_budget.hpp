// frame_budget.hpp - how many Gaussians a frame may have to stay within a time.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>

namespace rgs::detail {

/// Takes what frames took, and gives the next one's limit. A frame over its time lowers the limit at once to what would
/// have taken three quarters of it; one below half of its time raises it by an eighth. Between the two nothing changes,
/// which is more than a step of the detail, so the detail does not go to and fro.
class FrameBudget {
 public:
  std::uint64_t max_gaussians() const { return most_; }

  /// `gaussians` > 0: of the frame's cut, as RenderOptions::max_gaussians counts them. `ms`: what it took.
  void drew(double ms, double frame_ms, std::uint64_t gaussians) {
    constexpr double kAim = 0.75, kRoomy = 0.5;
    // One slow frame, such as the first, tells little about the next.
    constexpr double kLeast = 0.25;
    const auto n = static_cast<double>(gaussians);
    if (ms > frame_ms) {
      most_ = std::max(static_cast<std::uint64_t>(n * std::max(kAim * frame_ms / ms, kLeast)), std::uint64_t{1});
    } else if (ms < kRoomy * frame_ms) {
      // Time is about proportional to Gaussians, if they are what takes it.
      const double fits = std::min(n * kAim * frame_ms / std::max(ms, 1e-6), static_cast<double>(kUnlimited));
      const std::uint64_t more = most_ + std::min(most_ / 8 + 1, kUnlimited - most_);
      most_ = std::max(most_, std::min(more, static_cast<std::uint64_t>(fits)));
    }
  }

 private:
  static constexpr std::uint64_t kUnlimited = std::uint64_t{1} << 62;  // more than any scene has
  std::uint64_t most_ = kUnlimited;
};

}  // namespace rgs::detail
