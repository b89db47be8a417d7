// cuda_backend.hpp - what Renderer needs of a GPU, in builds with and without CUDA.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "rgs/renderer.hpp"

namespace rgs::detail {

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
  const char* name() const;

 private:
  struct Impl;
  explicit CudaBackend(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::detail
