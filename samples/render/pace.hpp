// pace.hpp - frames at a steady rate: when each is due, which come late, and how long the next may be drawn.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

namespace rgs::render {

/// Times are ms since the first frame began.
class Pace {
 public:
  explicit Pace(double fps) : frame_ms_(1e3 / fps) {}

  /// When the next frame is due. `now_ms`: when it could begin.
  double begin(double now_ms) {
    const double due_ms = frame_ms_ * n_frames_;
    if (n_frames_++ > 0) other_ms_ = now_ms - begin_ms_ - drawn_ms_;
    n_late_ += now_ms > due_ms ? 1 : 0;
    begin_ms_ = std::max(now_ms, due_ms);
    return due_ms;
  }
  /// What drawing may take so that the frame after it is not late either: until that is due, less what else the last
  /// frame took. A late frame gets less, so that it is made up for, but at least a quarter of a frame's share.
  double draw_ms() const { return std::max(frame_ms_ * std::max(n_frames_, 1) - begin_ms_ - other_ms_, frame_ms_ / 4); }
  /// What drawing the frame took.
  void drew(double draw_ms) { drawn_ms_ = draw_ms; }

  int n_late() const { return n_late_; }

 private:
  double frame_ms_;
  double begin_ms_ = 0, drawn_ms_ = 0, other_ms_ = 0;
  int n_frames_ = 0, n_late_ = 0;
};

}  // namespace rgs::render
