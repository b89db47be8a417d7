// cuda_backend.hpp - what Renderer needs of a GPU. Built with and without CUDA.
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

/// What a frame draws of a scene whose pages are in a device's slots. Constant until the frame is drawn.
struct SlotDraw {
  const DeviceSlots& slots;
  std::span<const std::uint32_t> chunks;  ///< among all slots' chunks, page after page in the order of leaves
  std::uint64_t gaussians;                ///< of these pages
  std::uint32_t pages;
  const Declarations& declarations;
};

/// Draws frames on a device and copies them to host memory. Keeps the last scene on the device. Makes its device
/// current for each call, and for its own end, which frees what is there.
class CudaBackend {
 public:
  /// `device`: CUDA's number, at least 0; absent: the current device. Errors: bad_argument (no such device),
  /// unavailable (not built, or no device answers), device_out_of_memory, device_failed.
  static Result<CudaBackend> create(std::optional<int> device);
  CudaBackend(CudaBackend&&) noexcept;
  ~CudaBackend();

  /// Uploads the scene. Errors: those of DeviceScene::upload().
  Status prepare(const Scene& scene);
  /// The caller has checked camera, options and target. Errors: those of CudaRenderer::render().
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  /// The same of resident pages, on their device; the frame is complete after any return. Waits for frames of other
  /// renderers that draw from the same slots, and shares their workspace, which holds all that a frame takes. Errors:
  /// also device_out_of_memory (the frame does not fit the workspace, which is then released).
  Result<FrameStats> render(const SlotDraw& draw, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  /// Takes valid cameras of one size and valid options. Errors: those of PictureBatch::render().
  Result<std::vector<FrameStats>> render_all(const Scene& scene, std::span<const Camera> cameras,
                                             const PictureArrays& pictures, const RenderOptions& options);
  /// `bytes` > 0. Errors: device_out_of_memory, device_failed.
  Result<DeviceBlock> allocate(std::uint64_t bytes) const;
  const char* name() const;

 private:
  struct Impl;
  explicit CudaBackend(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::detail
