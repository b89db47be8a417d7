// cuda_renderer.hpp - frames on an NVIDIA GPU: scenes and pictures in device memory, on the caller's stream.
// SPDX-License-Identifier: Apache-2.0
//
// Needs no header of the CUDA toolkit. Renderer (renderer.hpp) gives the same pictures in host memory; this is for
// programs that keep scenes and frames on the device.
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

/// Allocates device memory; both functions or none. The default is a pool of the library's own, so that allocation and
/// release stop none of the caller's streams; if the driver has no pools, or the pool finds no room, cudaMalloc(),
/// which may. The functions run on the thread that calls the library and must not throw.
struct DeviceAllocator {
  /// `bytes` > 0 of the current device's memory, aligned to 256 bytes, for work queued on `stream` from now on; null if
  /// there is not enough.
  void* (*allocate)(void* user, std::uint64_t bytes, CudaStream stream) = nullptr;
  /// Releases it. The device no longer uses it.
  void (*free)(void* user, void* memory, std::uint64_t bytes) = nullptr;
  void* user = nullptr;  ///< passed to both; must outlive all memory not yet released
};

/// Where DeviceScene::upload() of a file spends its time, in consecutive phases; overlapping work counts in the phase
/// in which it ends.
struct UploadTimes {
  double setup_ms = 0;   ///< page-locked and device memory, streams
  double host_ms = 0;    ///< then, until all is read, decompressed and queued for the device
  double device_ms = 0;  ///< then, until the device has copied, decoded and checked
};

struct UploadOptions {
  CudaStream stream = nullptr;  ///< for the copies and the kernels after them
  /// Return once the copies are queued. The uploaded arrays must stay unchanged, and the stream must live, until the
  /// stream has done its work. Frames on any stream wait for the upload on the device.
  bool asynchronous = false;
  DeviceAllocator allocator = {};
  /// The rest is for a FileView alone. validate: as in LoadOptions; false if the file has been validated before.
  bool validate = true;
  bool decode_on_host = false;   ///< decode with load_direct() and copy: for comparison
  UploadTimes* times = nullptr;  ///< filled on success
};

namespace detail {
class CudaBackend;
struct SceneStorage;
}  // namespace detail

/// Gaussians in the current device's memory. Copies share them; the last one frees them. Thread-safe to read.
class DeviceScene {
 public:
  DeviceScene() = default;  ///< no Gaussians

  /// Activated FP32 attributes in the original's layout, 236 bytes a Gaussian at SH degree 3. Waits unless
  /// asynchronous. Errors: bad_argument (sizes that contradict each other, an SH degree not 0..3, half an allocator),
  /// limit_exceeded (2^31 Gaussians or more), device_out_of_memory, device_failed.
  static Result<DeviceScene> upload(const SceneView& scene, const UploadOptions& options = {});
  /// The sections of an .rgs file, or of some of its chunks, byte for byte: 76 bytes a Gaussian at SH degree 3.
  /// load_direct() or read_chunks() has validated them; only values that kernels use as an index are checked again.
  /// Errors: those of FileView::chunk() and of the other overload.
  static Result<DeviceScene> upload(const DirectData& data, const UploadOptions& options = {});
  /// The same of a whole file, decoded and checked on the way: host threads decompress coded sections into a ring of
  /// page-locked memory (32 MiB, or two frames), and the device makes rows of them and checks their values, in up to
  /// 96 MiB that it then releases. Of Profile::archive the device holds the coded sections and decodes them in up to
  /// 1 GiB, less where memory is short. The host never holds the scene, but that of Codec::archive_draco, or of an
  /// archive for which the device has no memory: it decodes these itself. Always waits: the file is not used after
  /// the return. Errors: those of load_direct(), with its offsets, and of the other overloads.
  static Result<DeviceScene> upload(const FileView& file, const UploadOptions& options = {});

  /// All pages that a file with levels of detail contains, in the same form, decoded and checked by host threads a few
  /// at a time, in 40 MB of page-locked memory: 76 bytes a Gaussian at SH degree 3, up to a chunk of padding a page
  /// that is not a leaf, and 48 bytes a page. CudaRenderer chooses the cut on the device, by RenderOptions::detail_px
  /// and max_gaussians. Always waits. Errors: pages_missing (even the root), those of PageDecoder and check_page_values(), and of the
  /// other overloads.
  static Result<DeviceScene> upload(const PagedFile& file, const UploadOptions& options = {});

  std::uint64_t size() const;  ///< Gaussians; with levels of detail those of the finest pages
  int sh_degree() const;
  bool compact() const;          ///< as stored in the file, dequantised by the kernels
  bool has_levels() const;       ///< of a PagedFile
  std::uint64_t bytes() const;   ///< device memory held now
  const Origin& origin() const;  ///< of its means
  /// What the .rgs file declares; absent for FP32 scenes.
  const std::optional<Declarations>& declarations() const;

 private:
  friend class CudaRenderer;
  friend class detail::CudaBackend;
  explicit DeviceScene(std::shared_ptr<const detail::SceneStorage> storage) : storage_(std::move(storage)) {}
  static Result<DeviceScene> upload_decoded(const FileView& file, const UploadOptions& options);
  std::shared_ptr<const detail::SceneStorage> storage_;
};

/// Bytes from one row to the next of each output, a multiple of its element's size; 0 = contiguous rows.
struct RowPitches {
  std::uint64_t rgb = 0, alpha = 0, depth = 0, evaluated = 0, blended = 0, packed = 0, codes = 0;
};

/// The caller's device memory for a frame: arrays of camera.width * camera.height pixels as in RenderTarget, null for
/// outputs not wanted. Padding between rows is not written.
struct DeviceTarget {
  float* rgb = nullptr;                ///< [height, width, 3]
  float* alpha = nullptr;              ///< [height, width]
  float* depth = nullptr;              ///< [height, width]
  std::uint32_t* evaluated = nullptr;  ///< [height, width]
  std::uint32_t* blended = nullptr;    ///< [height, width]
  std::uint8_t* codes = nullptr;       ///< [height, width, 3] math::code8() of rgb
  void* packed = nullptr;              ///< [height, width] colour and alpha in one word each, aligned to its size
  math::PixelFormat format = math::PixelFormat::rgba8;  ///< of `packed` or `surface`
  /// A cudaSurfaceObject_t that takes the packed pixels instead of `packed`: a two-dimensional array of at least the
  /// image's size whose elements have the format's size. 0 = none.
  std::uint64_t surface = 0;
  RowPitches pitch = {};
};

struct CudaRendererOptions {
  /// For the workspace. Where asynchronous frames overlap, `stream` may be one of the renderer's own.
  DeviceAllocator allocator = {};
  /// Asynchronous frames that are queued before render() waits for the oldest of them, 1 to 16. More than two take no
  /// more device memory.
  std::uint32_t frames_in_flight = 3;
  /// Asynchronous frames of scenes without levels of detail overlap: while one is blended, the next one's lists are
  /// made. This takes a second workspace, which the renderer adds when it first queues a frame behind another, if half
  /// of the device's free memory has room for it then. It releases it for good when it finds no memory to grow, but not
  /// when others need memory: set false for them. With one workspace a frame begins when the one before has ended.
  bool overlapping = true;
};

/// Renders frames into device memory. Owns the workspace, which is sized for the first scene; when a frame needs more
/// it grows by half, or by what is needed if there is no more; other frames do not allocate. To grow, it waits for its
/// own last frame alone. One CudaRenderer serves one thread at a time; its frames end in order, also on different
/// streams. Several may run on streams of their own and share scenes. The device current at create() must be current at
/// every call. The destructor waits for the last frame; a moved-from one may only be destroyed or assigned to.
class CudaRenderer {
 public:
  /// On the current device. Errors: unavailable (no device or driver answers, or this build has no code for the device),
  /// bad_argument (half an allocator, a number of frames out of range), device_failed.
  static Result<CudaRenderer> create(const CudaRendererOptions& options = {});

  CudaRenderer(CudaRenderer&&) noexcept;
  CudaRenderer& operator=(CudaRenderer&&) noexcept;
  ~CudaRenderer();

  /// Enqueues a frame on `stream` and returns; the target is complete when the stream has done its work. The scene may
  /// be destroyed before that: its destructor waits for the frame. With levels of detail, options are read as by
  /// Renderer::render(), and the drawn pages' memory is part of the workspace. Waits for the number of (tile, Gaussian)
  /// pairs; if the workspace is too small it grows, and the frame is repeated and waited for, up to three times in a
  /// row for turbo's different counts, and once before these for a larger cut. With options.measure.timings or
  /// .count_pairs it also waits for the end of the frame. All counts but evaluated and blended (0 unless counted) are
  /// exact on return. Errors: bad_camera, bad_argument (see Renderer::render(); an unaligned target, a pitch smaller
  /// than a row, a surface smaller than the image), limit_exceeded (2^31 pairs or Gaussians or more, 2^30
  /// Gaussians in a panorama), device_out_of_memory (Error::expected: bytes wanted; the renderer remains usable),
  /// device_failed; also those of a queued frame that it settles; this frame is then not drawn.
  ///
  /// With options.turbo.asynchronous it queues the frame and waits for nothing but a larger workspace and, if
  /// frames_in_flight are queued, for the oldest of them, which it settles first. The frame runs at the default
  /// priority, whatever the stream's. If it overlaps with the frame before (CudaRendererOptions::overlapping), it may
  /// begin before earlier work on `stream` is done, but writes its target only after that; work that is queued there
  /// later follows it. Its times then include the wait and what the other frame takes of the device. A frame that is
  /// not asynchronous settles all. To settle a frame is to wait for its end and check whether it fitted; if not, the
  /// workspace grows, and this frame and those queued after it are drawn again, each on its stream. Frames are settled
  /// in their order, and only then is a picture confirmed: until the call that settles its frame has returned, stream
  /// and target must live. An error of a queued frame is told once, by the call that settles it; then no frame is
  /// queued or running, those queued after it have no picture, and the renderer remains usable. After other errors
  /// queued frames remain queued.
  Result<FrameStats> render(const DeviceScene& scene, const Camera& camera, const DeviceTarget& target,
                            const RenderOptions& options = {}, CudaStream stream = nullptr);

  /// Settles all queued frames, waits for the last frame, asynchronous or not, and returns what a waiting render()
  /// would have returned for it; zeros before the first frame and after an error. Errors: those of render() for a
  /// queued frame.
  Result<FrameStats> finish();

  /// Settles the oldest queued frame alone and returns its counts, so that its picture can be shown while those after
  /// it are drawn. Without a queued frame the same as finish(). A program that calls this before every render() that
  /// would find frames_in_flight queued gets each frame, in order. Errors: as finish().
  Result<FrameStats> finish_oldest();

  std::uint64_t bytes() const;  ///< device memory held by the workspace, or by both
  const char* name() const;     ///< e.g. "cuda NVIDIA H100 80GB HBM3"

 private:
  struct Impl;
  explicit CudaRenderer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs
