// picture_batch.hpp - pictures of several cameras, several of them in flight.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "cuda/cuda_objects.hpp"
#include "cuda/device_memory.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Small frames leave most of a device idle. So several renderers, each with a workspace, a stream and several frames
/// in flight, draw them in turn.
class PictureBatch {
 public:
  /// Of each renderer, also of `first`.
  static constexpr std::uint32_t kFramesInFlight = 3;

  /// `first` is one of the renderers and must outlive this.
  PictureBatch(CudaRenderer& first, std::shared_ptr<const DeviceMemory> memory)
      : first_(first), memory_(std::move(memory)) {}

  /// Takes valid cameras of one size. Everything is complete on return, also after errors. Errors: those of
  /// CudaRenderer::render(); bad_argument (an array is not in the current device's memory).
  Result<std::vector<FrameStats>> render(const DeviceScene& scene, std::span<const Camera> cameras,
                                         const PictureArrays& pictures, const RenderOptions& options);

 private:
  struct Lane {
    CudaRenderer* renderer = nullptr;
    std::unique_ptr<CudaRenderer> own = {};  // of all lanes but the first
    OwnedStream stream = {};
  };

  Result<std::vector<FrameStats>> render_on_device(const DeviceScene& scene, std::span<const Camera> cameras,
                                                   const PictureArrays& pictures, const RenderOptions& options);
  Result<std::vector<FrameStats>> render_to_host(const DeviceScene& scene, std::span<const Camera> cameras,
                                                 const PictureArrays& pictures, const RenderOptions& options);
  Status draw(const DeviceScene& scene, std::span<const Camera> cameras, const PictureArrays& pictures,
              const RenderOptions& options, std::span<Lane* const> lanes, std::vector<FrameStats>& stats);
  Status add_lane();

  CudaRenderer& first_;
  std::shared_ptr<const DeviceMemory> memory_;
  std::vector<std::unique_ptr<Lane>> lanes_;
  DeviceBuffer rgb_, codes_, alpha_, depth_;  // staged for the host
};

}  // namespace rgs::detail
