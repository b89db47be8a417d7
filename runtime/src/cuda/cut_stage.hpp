// cut_stage.hpp - the stage before the front ends, of scenes with levels of detail: which chunks a frame draws, and the tie
// order of what is in them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>

#include "common/cut.hpp"
#include "common/tie_order.hpp"
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
  /// What the front ends want besides the list of chunks.
  enum class Order {
    of_drawn_rows,  ///< the tie order of drawn rows, and their ranks
    of_rows,        ///< the same rows as the scene numbers them, without ranks
    none            ///< only of a scene whose chunks the host has chosen: rows() will do
  };
  /// Makes room for `n_chunks` and more, or, if that is 0, for a first guess where there is none; but for at most `max_chunks`.
  /// `splats` gets room for as many. Before every launch. Errors: those of `reserve`.
  Status reserve(const SceneStorage& scene, std::uint64_t n_chunks, std::uint64_t max_chunks, Order order,
                 DeviceBuffer& splats, const Reserve& reserve);
  /// What a frame draws, and how.
  struct Choice {
    cuda::CutEye eye;
    cuda::ViewParameters view;
    bool by_view;  ///< leave out what is not in view, which holds for tiles that a Gaussian's ellipse touches
    Order order;
  };
  /// Queues the choice. Errors: device_failed.
  Status launch(const SceneStorage& scene, const Choice& choice, CudaStream stream) const;

  /// Of the frame queued last, once the device has come so far.
  const cuda::CutCounts& seen() const { return *seen_.get(); }
  /// Whether it had room. If not, nothing was drawn.
  bool fits() const { return seen().chunks <= capacity_; }

  std::uint64_t capacity() const { return capacity_; }  ///< chunks
  cuda::DrawnChunks drawn() const;
  cuda::TieOrder ties() const { return {order_.as<std::uint32_t>(), rank_.as<std::uint32_t>()}; }
  cuda::ChosenRows rows(const SceneStorage& scene) const;
  std::uint64_t bytes() const;

 private:
  Status launch_chosen(const SceneStorage& scene, Order order, CudaStream stream) const;
  std::uint64_t held(const SceneStorage& scene, Order order, const DeviceBuffer& splats) const;

  std::uint64_t capacity_ = 0;
  PageLocked<cuda::CutCounts> seen_;
  DeviceBuffer counts_;   ///< [2 + blocks] what is chosen, what is listed, and sums of blocks
  DeviceBuffer chosen_;   ///< [all chunks]
  DeviceBuffer in_view_;  ///< sums of blocks
  DeviceBuffer chunks_;   ///< [capacity]
  DeviceBuffer places_;   ///< [all chunks]
  DeviceBuffer bits_, bit_sums_;
  DeviceBuffer order_, rank_;  ///< [rows]
  DeviceBuffer sort_;          ///< of what the host has chosen
};

}  // namespace rgs::detail
