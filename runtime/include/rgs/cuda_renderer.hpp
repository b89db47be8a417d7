// cuda_renderer.hpp - frames on an NVIDIA GPU: scenes and pictures in device memory, on the caller's stream.
// SPDX-License-Identifier: Apache-2.0
//
// Needs no header of the CUDA toolkit. Renderer (renderer.hpp) is the simple way to the same pictures in host memory;
// this is for programs that keep scenes and frames on the device.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>

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

/// Where device memory comes from; both functions or none. By default it comes from a pool of the library's own, so
/// that taking it and giving it back stops no stream of the caller's; where the driver has no pools, or the pool finds no
/// room, from cudaMalloc(), which may stop them. The functions are called on the thread that calls the library and must not throw.
struct DeviceAllocator {
  /// `bytes` > 0 of the current device's memory, aligned to 256 bytes, for what is queued on `stream` from now on; null
  /// if there is not that much.
  void* (*allocate)(void* user, std::uint64_t bytes, CudaStream stream) = nullptr;
  /// Takes it back. Nothing on the device uses it any longer.
  void (*free)(void* user, void* memory, std::uint64_t bytes) = nullptr;
  void* user = nullptr;  ///< handed to both; must outlive all memory that is not taken back
};

/// Where the time of DeviceScene::upload() of a file goes. What happens side by side is counted once: with what it ends
/// with.
struct UploadTimes {
  double setup_ms = 0;   ///< page-locked and device memory, streams
  double host_ms = 0;    ///< then, until everything is read, decompressed and on its way to the device
  double device_ms = 0;  ///< then, until the device has copied, decoded and checked what was left, and has ordered ties
};

struct UploadOptions {
  CudaStream stream = nullptr;  ///< for the copies and what is made of them
  /// Return once the copies are queued. What is uploaded must keep its place and its values, and the stream must live,
  /// until the stream has done its work. Frames on any stream wait for the upload, on the device. The scene holds the 4 bytes
  /// a Gaussian that its tie order (docs/format/RENDERING.md) takes to make until the first frame that begins after it.
  bool asynchronous = false;
  DeviceAllocator allocator = {};
  /// Of a FileView alone. validate: as LoadOptions has it; without, the file has been validated before.
  bool validate = true;
  bool decode_on_host = false;   ///< by load_direct(), and copied then: to compare with
  UploadTimes* times = nullptr;  ///< filled on success
};

namespace detail {
class CudaBackend;
struct SceneStorage;
}  // namespace detail

/// Gaussians in the current device's memory. Copies share them; the last one frees them. Reading is thread-safe.
class DeviceScene {
 public:
  DeviceScene() = default;  ///< no Gaussians

  /// Activated FP32 attributes, 236 bytes a Gaussian at SH degree 3: the original's layout; and 8 bytes of its place in tie
  /// order. Needs 4 bytes a Gaussian more for its time. Waits for all that unless it is asynchronous. Errors: bad_argument
  /// (sizes that contradict each other, an SH degree not 0..3, half an allocator), limit_exceeded (2^31 Gaussians or more),
  /// device_out_of_memory, device_failed.
  static Result<DeviceScene> upload(const SceneView& scene, const UploadOptions& options = {});
  /// The sections of an .rgs file, or of some of its chunks, byte for byte: 76 bytes a Gaussian at SH degree 3, and 8 of its
  /// place in tie order. They are what load_direct() or read_chunks() has validated: of values only what the kernels use as an index is
  /// checked again. Errors: those of FileView::chunk() and of the other overload.
  static Result<DeviceScene> upload(const DirectData& data, const UploadOptions& options = {});
  /// The same of a whole file, which is decoded and checked on the way: threads of the host decompress what is packed into
  /// a ring of page-locked memory (32 MiB, or two frames), the device makes rows of it and checks their values, in
  /// up to 96 MiB of memory that it gives back. The host never holds the scene, but for Profile::archive, which it decodes itself.
  /// Always waits: nothing of the file is used on return. Errors: those of load_direct(), with its offsets, and of the
  /// other overloads.
  static Result<DeviceScene> upload(const FileView& file, const UploadOptions& options = {});

  /// All pages of a file with levels of detail that are there, in the same form, decoded and checked by the host's threads, a few
  /// at a time, in 40 MB of page-locked memory: 84 bytes a Gaussian at SH degree 3, with up to a chunk of padding a page that is no
  /// leaf, and 48 bytes a page. CudaRenderer chooses among them by RenderOptions::detail_px, on the device. Always waits. Errors:
  /// pages_missing (not even the root is there), those of PageDecoder and check_page_values(), and of the other overloads.
  static Result<DeviceScene> upload(const PagedFile& file, const UploadOptions& options = {});

  std::uint64_t size() const;  ///< Gaussians; with levels of detail those of the finest pages
  int sh_degree() const;
  bool compact() const;          ///< as in the file, dequantised by the kernels
  bool has_levels() const;       ///< of a PagedFile
  std::uint64_t bytes() const;   ///< device memory held now
  const Origin& origin() const;  ///< that its means are relative to
  /// What the .rgs file declares; absent for FP32 scenes.
  const std::optional<Declarations>& declarations() const;

 private:
  friend class CudaRenderer;
  friend class detail::CudaBackend;
  explicit DeviceScene(std::shared_ptr<const detail::SceneStorage> storage) : storage_(std::move(storage)) {}
  static Result<DeviceScene> upload_decoded(const FileView& file, const UploadOptions& options);
  std::shared_ptr<const detail::SceneStorage> storage_;
};

/// Bytes from a row to the next of each output, a multiple of its element's size; 0 = rows follow each other.
struct RowPitches {
  std::uint64_t rgb = 0, alpha = 0, depth = 0, evaluated = 0, blended = 0, packed = 0;
};

/// Device memory of the caller's for a frame: arrays of camera.width * camera.height pixels as in RenderTarget, null
/// where an output is not wanted. Nothing is written between rows.
struct DeviceTarget {
  float* rgb = nullptr;                ///< [height, width, 3]
  float* alpha = nullptr;              ///< [height, width]
  float* depth = nullptr;              ///< [height, width]
  std::uint32_t* evaluated = nullptr;  ///< [height, width]
  std::uint32_t* blended = nullptr;    ///< [height, width]
  void* packed = nullptr;              ///< [height, width] colour and alpha in one word each, aligned to its size
  math::PixelFormat format = math::PixelFormat::rgba8;  ///< of `packed` or `surface`
  /// A cudaSurfaceObject_t that takes the packed pixels in place of `packed`: a two-dimensional array of at least the
  /// image's size whose elements are as large as the format's. 0 = none.
  std::uint64_t surface = 0;
  RowPitches pitch = {};
};

struct CudaRendererOptions {
  DeviceAllocator allocator = {};  ///< of the workspace
};

/// Renders frames into device memory. Holds the workspace, which is sized for the first scene and grows by half when a
/// frame needs more, or by what it needs where that is all there is; no frame allocates otherwise. To grow, it waits for
/// its own last frame alone. One CudaRenderer serves one thread at a time; its frames follow each other also on different
/// streams. Several may run on streams of their own and share scenes. The device current at create() must be current at
/// every call. Everything is freed with it, once its last frame is made; a moved-from one may only be destroyed or
/// assigned to.
class CudaRenderer {
 public:
  /// On the current device. Errors: unavailable (no device or driver answers, or this build has no code for the device),
  /// bad_argument (half an allocator), device_failed.
  static Result<CudaRenderer> create(const CudaRendererOptions& options = {});

  CudaRenderer(CudaRenderer&&) noexcept;
  CudaRenderer& operator=(CudaRenderer&&) noexcept;
  ~CudaRenderer();

  /// Enqueues a frame on `stream` and returns; the target is complete when the stream has done its work. The scene may be
  /// destroyed before that: its destructor waits for the frame. Of a scene with levels of detail, options are read as
  /// Renderer::render() reads them, and room for what is drawn is a part of the workspace. Waits for the
  /// number of (tile, Gaussian) pairs; where the workspace is too small it grows, and the frame is made and waited for
  /// again. That can happen three times in a row, each time for another of turbo's counts, and before these for a cut that draws more
  /// than before. With options.measure.timings or
  /// .count_pairs also waits for the end of the frame. All counts but evaluated and blended (0 unless counted) are exact
  /// on return. Errors: bad_camera, bad_argument (see Renderer::render(); a target that is not aligned, a pitch smaller
  /// than a row, a surface that does not hold the image), limit_exceeded (2^31 pairs or more), device_out_of_memory
  /// (Error::expected: bytes wanted; the renderer remains usable), device_failed; also those of the frame before, if that
  /// was asynchronous: it is given up then.
  ///
  /// With options.turbo.asynchronous nothing is waited for. The stream and the target must live until finish() or the
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
