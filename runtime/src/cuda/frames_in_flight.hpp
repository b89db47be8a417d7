// frames_in_flight.hpp - a renderer's queued frames, and what happens to them when one did not fit or failed.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <type_traits>
#include <utility>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::detail {

/// Frames that are queued and not yet known to fit, in the order in which they were queued.
template <class Frame>
class FramesInFlight {
 public:
  /// `most` >= 1 frames.
  explicit FramesInFlight(std::size_t most) : most_(most) { frames_.reserve(most); }

  bool is_empty() const { return frames_.empty(); }
  bool is_full() const { return frames_.size() == most_; }
  /// A number below `most` for the next frame, which no other frame has unless is_full().
  std::size_t next_number() const { return n_added_ % most_; }
  /// Not if is_full(). Allocates nothing.
  void add(Frame frame) {
    frames_.push_back(std::move(frame));
    ++n_added_;
  }

  /// Removes the oldest frame, which must be there. settle(frame) waits until its picture is right and returns a Result
  /// whose value says whether it `is_repeated`; then queue(frame) is called for each later frame in turn, because they
  /// may have the same target and follow it on its stream. After an error of either, all frames are removed.
  template <class Settle, class Queue>
  std::invoke_result_t<Settle, const Frame&> settle_oldest(const Settle& settle, const Queue& queue) {
    auto settled = settle(std::as_const(frames_.front()));
    for (std::size_t i = 1; settled && settled->is_repeated && i < frames_.size(); ++i) {
      if (const Status ok = queue(std::as_const(frames_[i])); !ok) settled = tl::unexpected(ok.error());
    }
    frames_.erase(frames_.begin(), settled ? frames_.begin() + 1 : frames_.end());
    return settled;
  }

 private:
  std::size_t most_, n_added_ = 0;
  std::vector<Frame> frames_;
};

}  // namespace rgs::detail
