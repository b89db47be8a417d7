// cut_stage.hpp - the stage before the front ends for scenes with levels of detail: the chunks that a frame draws.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <limits>

#include "common/cut.hpp"
#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "cuda/device_scene.hpp"

namespace rgs::detail {

/// The kernels index splats, and CUB counts them, with 31 bits.
inline constexpr std::uint64_t kMaxSplats = std::numeric_limits<std::int32_t>::max();
/// Errors: limit_exceeded.
inline Status check_splats(std::uint64_t n) {
  if (n <= kMaxSplats) return {};
  return make_error(Errc::limit_exceeded, Error::kNone,
                    "more Gaussians than a frame can draw, counted twice in a panorama", kMaxSplats, n);
}

/// Owns its part of the workspace. The host learns how much a frame draws only with the frame's counts, so the stage
/// has room for what earlier frames drew, and half as much again once that was not enough.
class CutStage {
 public:
  /// FrameState::reserve() for the frame.
  using Reserve = std::function<Status(DeviceBuffer&, std::uint64_t bytes)>;

  /// Makes room for at least `n_chunks`, or for a first guess if that is 0 and there is none; `splats` gets room for as
  /// many, each with `chunk_splats`. Call before every launch. Errors: those of check_splats() and `reserve`.
  Status reserve(const SceneStorage& scene, std::uint64_t n_chunks, DeviceBuffer& splats, std::uint64_t chunk_splats,
                 const Reserve& reserve);
  struct Choice {
    cuda::CutEye eye;
    cuda::ViewParameters view;
    bool by_view;           ///< leave out what is out of view, by the tiles that a Gaussian's ellipse touches
    cuda::CutCounts* seen;  ///< page-locked: the frame's counts, once the device has written them
  };
  /// Queues the choice. Errors: device_failed.
  Status launch(const SceneStorage& scene, const Choice& choice, CudaStream stream) const;

  std::uint64_t capacity() const { return capacity_; }  ///< chunks; of a frame that has more, nothing is drawn
  cuda::DrawnChunks drawn() const;
  std::uint64_t bytes() const;

 private:
  Status launch_choice(const SceneStorage& scene, const Choice& choice, CudaStream stream) const;
  std::uint64_t held(const DeviceBuffer& splats, std::uint64_t splat_bytes) const;

  std::uint64_t capacity_ = 0;
  DeviceBuffer counts_;   ///< [2 + blocks] chosen, listed, and sums of blocks
  DeviceBuffer limit_;    ///< how a limit of Gaussians finds its detail
  DeviceBuffer chosen_;   ///< [all chunks]
  DeviceBuffer in_view_;  ///< sums of blocks
  DeviceBuffer chunks_;   ///< [capacity]
};

}  // namespace rgs::detail
