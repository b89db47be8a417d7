// cuda_renderer.hpp - frames on an NVIDIA GPU: scenes and pictures in device memory, on the caller's stream.
// SPDX-License-Identifier: Apache-2.0
//
// Needs no header of the CUDA toolkit. Renderer (renderer.hpp) is the simple way to the same pictures in host memory;
// this is for programs that keep scenes and frames on the device.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>

#include "rgs/camera.hpp"
#include "rgs/decode.hpp"
#include "rgs/math/pixel_format.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

struct CUstream_st;

namespace RGS_API rgs {

/// cudaStream_t; null is the default stream.
using CudaStream = CUstream_st*;

/// Gaussians in the current device's memory. Copies share them; the last one frees them. Reading is thread-safe.
class DeviceScene {
 public:
  DeviceScene() = default;  ///< no Gaussians

  /// Activated FP32 attributes, 236 bytes a Gaussian at SH degree 3: the original's layout. Waits for the copy.
  /// Errors: limit_exceeded (2^31 Gaussians or more), device_out_of_memory, device_failed.
  static Result<DeviceScene> upload(const SceneView& scene);
  /// The sections of an .rgs file byte for byte, 76 bytes a Gaussian at SH degree 3; the file is validated first.
  /// Errors: those of validate() and of the other overload.
  static Result<DeviceScene> upload(const FileView& file);

  std::uint64_t size() const;
  int sh_degree() const;
  bool compact() const;         ///< as in the file, dequantised by the kernels
  std::uint64_t bytes() const;  ///< device memory held
  /// What the .rgs file declares; absent for FP32 scenes.
  const std::optional<Declarations>& declarations() const;

 private:
  friend class CudaRenderer;
  struct Storage;
  std::shared_ptr<const Storage> storage_;
};

/// Device memory for a frame: arrays of camera.width * camera.height pixels as in RenderTarget, null where an output is
/// not wanted.
struct DeviceTarget {
  float* rgb = nullptr;                ///< [height, width, 3]
  float* alpha = nullptr;              ///< [height, width]
  float* depth = nullptr;              ///< [height, width]
  std::uint32_t* evaluated = nullptr;  ///< [height, width]
  std::uint32_t* blended = nullptr;    ///< [height, width]
  void* packed = nullptr;              ///< [height, width] colour and alpha in one word each, aligned to its size
  math::PixelFormat format = math::PixelFormat::rgba8;  ///< of `packed`
};

/// Renders frames into device memory. Holds the workspace, which is sized for the first scene and grows by half when a
/// frame needs more, or by what it needs where that is all there is; no frame allocates otherwise. One CudaRenderer serves one thread at a time; its frames follow each
/// other also on different streams. Several may run on streams of their own and share scenes. The device current at
/// create() must be current at every call. Everything is freed with it; a moved-from one may only be destroyed or
/// assigned to.
class CudaRenderer {
 public:
  /// On the current device. Errors: unavailable (no device or driver answers), device_out_of_memory, device_failed.
  static Result<CudaRenderer> create();

  CudaRenderer(CudaRenderer&&) noexcept;
  CudaRenderer& operator=(CudaRenderer&&) noexcept;
  ~CudaRenderer();

  /// Enqueues a frame on `stream` and returns; the target is complete when the stream has done its work. Waits once,
  /// for the number of (tile, Gaussian) pairs, and once more if they did not fit and the frame is made again; with
  /// options.cuda.timings or .count_pairs also for the end of the frame. All counts but evaluated and blended (0 unless
  /// counted) are exact on return. Errors: bad_camera, bad_argument (see Renderer::render(); a packed target that is not
  /// aligned), limit_exceeded (2^31 pairs or more), device_out_of_memory (Error::expected: bytes wanted; the renderer
  /// remains usable), device_failed; also those of the frame before, if that was asynchronous: it is given up then.
  ///
  /// With options.cuda.asynchronous nothing is waited for. The stream and the target must live until finish() or the
  /// next render() has returned, which first learns whether the frame fitted, and if not makes it again on its stream:
  /// a picture that must be right is one that finish() has seen.
  Result<FrameStats> render(const DeviceScene& scene, const Camera& camera, const DeviceTarget& target,
                            const RenderOptions& options = {}, CudaStream stream = nullptr);

  /// Waits for the last frame, asynchronous or not, and returns what render() would have returned had it waited; zeros
  /// before the first frame. Errors: those of render() that a frame has once it is queued.
  Result<FrameStats> finish();

  std::uint64_t bytes() const;  ///< device memory held by the workspace
  const char* name() const;     ///< e.g. "cuda NVIDIA H100 80GB HBM3"

 private:
  struct Impl;
  explicit CudaRenderer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs
