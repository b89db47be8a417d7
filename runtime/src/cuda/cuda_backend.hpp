// cuda_backend.hpp - what Renderer needs of a GPU, in builds with and without CUDA.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/renderer.hpp"
#include "stream/device_slots.hpp"

namespace rgs::detail {

/// What a frame draws of a scene whose pages are in slots of a device. Nothing of it changes until the frame is made.
struct SlotDraw {
  const DeviceSlots& slots;
  std::span<const std::uint32_t> chunks;  ///< of all slots' chunks, page after page in the order of leaves
  std::uint64_t gaussians;                ///< of these pages
  std::uint32_t pages;
  const Declarations& declarations;
};

/// Frames in host memory by way of a device. Keeps the last scene on the device.
class CudaBackend {
 public:
  /// Errors: unavailable (not built, or no device answers), device_out_of_memory, device_failed.
  static Result<CudaBackend> create();
  CudaBackend(CudaBackend&&) noexcept;
  CudaBackend& operator=(CudaBackend&&) noexcept;
  ~CudaBackend();

  /// Brings the scene to the device. Errors: those of DeviceScene::upload().
  Status prepare(const Scene& scene);
  /// Camera, options and target are valid (the caller has checked them). Errors: those of CudaRenderer::render().
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  /// The same of a part of a scene; the frame is made on return, whatever that is. Errors: also bad_argument (another device is current).
  Result<FrameStats> render(const SlotDraw& draw, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  /// Cameras are valid and of one size, options valid. Errors: those of PictureBatch::render().
  Result<std::vector<FrameStats>> render_all(const Scene& scene, std::span<const Camera> cameras,
                                             const PictureArrays& pictures, const RenderOptions& options);
  /// `bytes` > 0. Errors: device_out_of_memory, device_failed.
  static Result<DeviceBlock> allocate(std::uint64_t bytes);
  const char* name() const;

 private:
  struct Impl;
  explicit CudaBackend(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::detail
