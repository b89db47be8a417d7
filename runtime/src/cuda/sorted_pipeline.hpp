// sorted_pipeline.hpp - the pipelines of the original and of the paper: pairs, one sort over the frame, ranges, pixels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "cuda/frame_state.hpp"
#include "sorted/sort.hpp"

namespace rgs::detail {

/// All functions may fail with device_out_of_memory (a workspace that did not grow still fits earlier frames, or is
/// empty) or device_failed.
class SortedPipeline {
 public:
  explicit SortedPipeline(FrameState& state) : state_(state) {}

  /// Enqueues a frame. Waits for the number of its pairs, which the last launches need, and before that for the cut's
  /// size.
  Status queue(const Frame& frame);
  /// Pairs of the frame queued last; above kMaxPairs it was not drawn.
  Result<Settled> settle(const Frame&) const { return Settled{n_pairs_, false}; }
  std::uint64_t bytes() const;  ///< workspace held

 private:
  Status reserve_scene(const Frame& frame);
  Status reserve_pairs(const Frame& frame, std::uint64_t needed, std::uint64_t generous);
  cuda::PairArrays pair_arrays(const Frame& frame) const;
  Status draw(const Frame& frame);
  Status count_and_write(const Frame& frame);
  Status count_then_write(const Frame& frame);
  Status order(const Frame& frame, cuda::SortBuffers& sorted);
  Status choose(const Frame& frame);

  FrameState& state_;

  std::uint64_t n_ = 0;
  std::uint64_t n_pairs_ = 0;
  DeviceBuffer counters_, covers_, tiles_, sums_, sum_temporary_, block_state_;
  DeviceBuffer keys_, spare_keys_, gaussians_, spare_gaussians_, sort_temporary_, ranges_;
};

}  // namespace rgs::detail
