// pace.hpp - frames at a steady rate: when each is due, which come late, and in how much detail to draw the next.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

namespace rgs::render {

/// Times are ms since the first frame began. A frame that takes longer to draw than its share makes the next one coarser
/// by a quarter, one that takes less than half makes it finer again, up to what was asked for. A detail of 0, the leaves,
/// stays.
class Pace {
 public:
  Pace(double fps, float detail_px) : frame_ms_(1e3 / fps), asked_px_(detail_px), detail_px_(detail_px) {}

  /// When the next frame is due. `now_ms`: when it could begin.
  double begin(double now_ms) {
    const double due_ms = frame_ms_ * n_frames_++;
    n_late_ += now_ms > due_ms ? 1 : 0;
    return due_ms;
  }
  /// `draw_ms`: what the frame took to draw.
  void drew(double draw_ms) {
    constexpr float kStep = 1.25F, kCoarsest = 1e3F;
    if (draw_ms > frame_ms_) detail_px_ = std::min(kStep * detail_px_, std::max(asked_px_, kCoarsest));
    if (draw_ms < frame_ms_ / 2) detail_px_ = std::max(asked_px_, detail_px_ / kStep);
  }

  float detail_px() const { return detail_px_; }  ///< of the next frame
  int n_late() const { return n_late_; }

 private:
  double frame_ms_;
  float asked_px_, detail_px_;
  int n_frames_ = 0, n_late_ = 0;
};

}  // namespace rgs::render
