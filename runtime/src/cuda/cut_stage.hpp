// cut_stage.hpp - the stage before the front ends, of scenes with levels of detail: which chunks a frame draws, and their tie
// order.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>

#include "common/cut.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "cuda/device_scene.hpp"

namespace rgs::detail {

/// Holds its part of the workspace. How much a frame draws, the host learns when the frame's counts come; the stage before has
/// room for what frames before have drawn, and for half as much again where that was not enough.
class CutStage {
 public:
  /// FrameState::reserve() on the frame's stream.
  using Reserve = std::function<Status(DeviceBuffer&, std::uint64_t bytes)>;

  /// Errors: device_failed.
  Status create() { return seen_.create(); }
  /// Makes room for `n_chunks` and more, or, if that is 0, for a first guess where there is none; but for at most `max_chunks`.
  /// Before every launch. Errors: those of `reserve`.
  Status reserve(const SceneStorage& scene, std::uint64_t n_chunks, std::uint64_t max_chunks, const Reserve& reserve);
  /// Queues the choice. by_row: the order is one of the scene's rows, otherwise one of drawn rows, and has ranks. Errors:
  /// device_failed.
  Status launch(const SceneStorage& scene, const cuda::CutEye& eye, bool by_row, CudaStream stream) const;

  /// Of the frame queued last, once the device has come so far.
  const cuda::CutCounts& seen() const { return *seen_.get(); }
  /// Whether it had room. If not, nothing was drawn.
  bool fits() const { return seen().chunks <= capacity_; }

  std::uint64_t capacity() const { return capacity_; }  ///< chunks
  cuda::DrawnChunks drawn(const SceneStorage& scene) const;
  cuda::TieOrder ties() const { return {order_.as<std::uint32_t>(), rank_.as<std::uint32_t>()}; }
  std::uint64_t bytes() const;

 private:
  std::uint64_t held(const SceneStorage& scene) const;

  std::uint64_t capacity_ = 0;
  PageLocked<cuda::CutCounts> seen_;
  DeviceBuffer sums_;    ///< of blocks, and of the frame behind them
  DeviceBuffer chunks_;  ///< [capacity]
  DeviceBuffer places_;  ///< [all chunks]
  DeviceBuffer bits_, bit_sums_;
  DeviceBuffer order_, rank_;  ///< [rows]
};

}  // namespace rgs::detail
