// renderer.hpp - frames of a scene, seen by a camera.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/ablation.hpp"
#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/layout.hpp"
#include "rgs/math/options.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace RGS_API rgs {

/// automatic: CUDA if a device answers, else the CPU.
enum class Backend { automatic, cpu, cuda };

struct RendererOptions {
  Backend backend = Backend::automatic;
  int threads = 0;   ///< CPU threads, at most as many as the machine has; 0: all
  bool simd = true;  ///< CPU: false runs the scalar definition in rgs::math, the reference for everything else
  /// CUDA's numbers of the drawing devices; not for Backend::cpu, nor replaced by the CPU. Each holds the whole
  /// scene. render_all() deals its pictures out, render() uses the first; a streamed scene is drawn where its pages
  /// are. A number may appear again: two renderers then share the device. Empty: the one that is current at create().
  std::vector<int> devices = {};
};

/// How a frame is made.
enum class Pipeline : std::uint8_t {
  /// Turbo on CUDA. On the CPU the image's definition: ellipses, exact order, direct exponents, exact exponentials.
  automatic,
  baseline,  ///< the original 3DGS rasteriser: all its settings, and its kernels on CUDA
  paper,     ///< the paper's, as changed by PaperSteps
  /// Lists per tile of 32x32 pixels, each ordered exactly on its own, instead of a sort over the frame; always
  /// deterministic. Where 2^27 Gaussians or more are in view, depths that differ in the last four bits at most may count
  /// as equal. FrameStats counts lists as bin_ms, their order as sort_ms. The CPU uses its arithmetic: ellipses, exact
  /// order, folded exponents.
  turbo,
};

/// For Pipeline::turbo on CUDA.
struct TurboOptions {
  /// Blends by matrix products in FP16; in FP32 if depth or counts are wanted or the low-pass is below 0.1. These
  /// products stop a pixel at a transmittance of 2^-11 instead of 1e-4, which loses up to an eighth of an 8-bit step of
  /// a white background. docs/develop/KERNELS.md has what this changes.
  bool tensor_cores = true;
  /// CudaRenderer::render() returns when the frame is queued, with several frames in flight; its counts are 0. If the
  /// workspace is too small, some or all tiles are missing until a later call settles and repeats the frame: see
  /// CudaRenderer::render(). Renderer always waits.
  bool asynchronous = false;
};

/// What CudaRenderer measures of a frame. Renderer always waits and fills the times; the CPU always counts and times.
struct MeasureOptions {
  bool timings = false;  ///< wait for the frame and fill FrameStats' times
  /// Also time the stages, by events between the kernels, which slow the frame a little.
  bool stage_timings = true;
  bool count_pairs = false;  ///< wait for the frame and count evaluated and blended pairs, which takes time
};

/// Default RenderOptions::detail_px of scenes with levels of detail: costs and savings in docs/develop/LEVELS.md.
inline constexpr float kDefaultDetailPx = 1;

/// What a frame shows and how it is made.
struct RenderOptions {
  std::array<float, 3> background = {0, 0, 0};  ///< red, green, blue, 0 to 1
  float near_plane = math::kNearPlane;          ///< Gaussians at a depth <= near_plane are not drawn
  float far_plane = 0;                          ///< Gaussians at a depth > far_plane are not drawn; 0 = no limit
  int sh_degree_limit = 3;                      ///< higher SH degrees are ignored
  /// px^2 added to the projected covariance; absent: as the scene declares, or default_low_pass_px2() if another
  /// anti-aliasing is requested than it declares.
  std::optional<float> low_pass = std::nullopt;
  std::optional<math::AntiAliasing> anti_aliasing = std::nullopt;  ///< absent: as the scene declares, else classic
  /// Of a scene with levels of detail, px: draws the pages whose error is at most so many pixels
  /// (docs/format/FORMAT.md, "Error and cut"), with Mip-Splatting's opacities and a low-pass of 0.1 px^2, for which
  /// they were fitted, unless these options say otherwise. 0: the leaves, drawn as a file without levels. Absent:
  /// kDefaultDetailPx, but 0 for Pipeline::baseline, which draws leaves alone, and where contributions are counted.
  /// Other scenes ignore it.
  std::optional<float> detail_px = std::nullopt;
  /// Of a scene with levels of detail: the detail is the finest of detail_px and coarser ones, in steps of 1.2, whose
  /// cut has at most so many Gaussians; the coarsest page is always drawn. Gaussians out of view count, so turning the
  /// camera changes nothing. The anti-aliasing is that of detail_px. Absent: no limit. Other scenes ignore it.
  std::optional<std::uint64_t> max_gaussians = std::nullopt;
  /// ms, of a scene with levels of detail: Renderer lowers max_gaussians, from frame to frame, until render() takes no
  /// longer, and raises it again after frames that took less than half of it. Not for contributions. render_all() on CUDA keeps to what render() has learned, and
  /// CudaRenderer ignores this. Absent: no limit. Pictures then depend on the machine and on the frames before.
  std::optional<double> frame_ms = std::nullopt;
  Pipeline pipeline = Pipeline::automatic;
  PaperSteps paper = {};  ///< for Pipeline::paper: rgs/ablation.hpp
  TurboOptions turbo = {};
  MeasureOptions measure = {};
};

/// `options` with absent fields filled from a scene's declarations: anti-aliasing (classic if not declared), low-pass,
/// range and mapping of the paper's key. Renderers do this with Scene::declarations(); use it to draw other scenes like
/// this one.
RenderOptions with_declarations(RenderOptions options, const std::optional<Declarations>& declared);

/// The detail that `options` ask for of `scene`, before max_gaussians: 0 without levels, or if its leaves are drawn.
/// Errors: bad_argument (negative, not finite, not 0 or a limit for baseline, or a frame_ms that is not above 0).
Result<float> drawn_detail(const RenderOptions& options, const Scene& scene);
/// The cut of scene.levels() for a camera at a detail, in the order of leaves. Errors: bad_argument (no levels).
Result<std::vector<std::uint32_t>> drawn_pages(const Scene& scene, const Camera& camera, float detail_px);

/// FrameStats::depth_resolution above which programs warn: Gaussians nearer to each other than this share of their
/// depth may swap. On a trained scene a logarithmic key gives 66 dB at 1.3e-5, 57 dB here, and 51 dB at 4e-4, where
/// channels are off by 121/255: docs/format/RENDERING.md, "Depth resolution".
inline constexpr double kCoarseDepthResolution = 1e-4;

/// What a frame cost. Counts are exact; times are wall clock of the calling thread, or of the device's stream.
struct FrameStats {
  double project_ms = 0;  ///< cull, project, colour; the whole fused front end
  double sort_ms = 0;     ///< order by depth, on CUDA by tile and depth; for turbo of the lists that are not long
  double bin_ms = 0;      ///< lists of Gaussians per tile; on CUDA pairs of the separate front end, and tile ranges
  /// Pixels; for turbo also the excess of its long lists, which are ordered and blended beside the others.
  double blend_ms = 0;
  double total_ms = 0;
  std::uint64_t gaussians = 0;  ///< in the scene, or in the drawn pages
  std::uint64_t pages = 0;      ///< drawn pages of a scene with levels of detail; 0 without
  float detail_px = 0;          ///< at which the pages were chosen; 0 without levels, and of the leaves
  std::uint64_t visible = 0;    ///< listed in at least one tile; on both sides of a panorama's seam twice
  std::uint64_t instances = 0;  ///< (tile, Gaussian) pairs
  std::uint64_t evaluated = 0;  ///< (pixel, Gaussian) pairs that pixels visited before they stopped
  std::uint64_t blended = 0;    ///< of these, pairs that contributed
  std::uint64_t bytes = 0;      ///< workspace held after the frame
  int depth_bits = 0;           ///< of the quantised key; 0 for exact order
  int key_bits = 0;             ///< CUDA: sorted bits of tile and depth
  /// Of the quantised key: the widest bin of the depth range, relative to the depth where it starts. If the middle of
  /// the scene's declared box lies in front of the camera and outside the range, at least that of its end bin, which
  /// then extends to the box's end. 0: exact order. FP32's own steps, 6e-8, do not count.
  double depth_resolution = 0;
  StreamStats stream;  ///< of a streamed scene; pages_missing also of one whose file lacks its end
};

/// Memory of a device. Copies share it; the last one waits for the device and frees it.
struct DeviceBlock {
  std::shared_ptr<void> data;
  int device = 0;  ///< CUDA's number of it
};

/// Renders frames. Owns the workspace, which grows and is reused. One Renderer serves one thread at a time; any number
/// of them may share a Scene.
class Renderer {
 public:
  /// Errors: bad_argument (negative thread count; devices that are not there, or for the CPU), unavailable (the backend
  /// is not built or no device answers), device_out_of_memory, device_failed. A moved-from Renderer may only be
  /// destroyed or assigned to. No call changes the thread's current device.
  static Result<Renderer> create(const RendererOptions& options = {});

  Renderer(Renderer&&) noexcept;
  Renderer& operator=(Renderer&&) noexcept;
  ~Renderer();

  /// Uploads the scene ahead of the first render(), which does it otherwise: each CUDA device takes it, with levels all
  /// pages, and decodes on the device what Scene::open() left in its file; the CPU makes its FP32 arrays. Errors: those
  /// of Scene::view() and DeviceScene::upload().
  Status prepare(const Scene& scene);

  /// Fills `target` and returns what it cost. Of a streamed scene draws the resident pages: the frame waits for no
  /// input, and FrameStats::stream says what is missing. Errors: bad_camera (see validate()), bad_argument (an option,
  /// the size of a target span, or contributions on CUDA or of a streamed scene), limit_exceeded (2^32 (tile, Gaussian)
  /// pairs or more, on CUDA 2^31, or 2^30 Gaussians in a panorama), device_out_of_memory, device_failed; before the
  /// scene is prepared, also those of prepare(); unavailable (of a streamed scene: on CUDA if the pool lacks
  /// StreamPoolOptions::device_memory, on the CPU if it has it).
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options = {});

  /// Pictures of several cameras of one size, each as by render(). CUDA keeps several in flight, which pays for small
  /// pictures. Of several devices each draws a run of the cameras on a thread of its own, unless the scene is streamed.
  /// Complete on return; stage times are those of a single picture. Errors: those of render(), the first in the order
  /// of these runs; bad_argument (sizes differ, an array is not in the device's memory, or arrays are but the scene is
  /// streamed or there are several devices), unavailable (device arrays, but the CPU draws).
  Result<std::vector<FrameStats>> render_all(const Scene& scene, std::span<const Camera> cameras,
                                             const PictureArrays& pictures, const RenderOptions& options = {});

  /// Waits until no page of a streamed scene is missing from this view and the file's table of pages is verified; then
  /// render() gives the picture of the whole file, byte for byte. Other scenes are complete at once. Waits for room that
  /// others are about to release. False: after `seconds`, or if the pool has no room for the rest of the view. Errors:
  /// those of Scene::status() that keep the view from completing; limit_exceeded (the pool has no room for the view, and
  /// nobody will release any); those of render().
  Result<bool> refine(const Scene& scene, const Camera& camera, double seconds, const RenderOptions& options = {});

  /// Memory of the first drawing device, for PictureArrays. Errors: unavailable (the CPU has none), bad_argument (0
  /// bytes), device_out_of_memory, device_failed.
  Result<DeviceBlock> allocate_on_device(std::uint64_t bytes) const;

  Backend backend() const;           ///< the backend in use, never automatic
  const char* backend_name() const;  ///< e.g. "cpu AVX3_SPR", "cpu scalar"

 private:
  Result<FrameStats> draw(const Scene& scene, const Camera& camera, const RenderTarget& target,
                          const RenderOptions& options);
  Result<FrameStats> render_streamed(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                     const RenderOptions& options);
  Result<std::vector<FrameStats>> render_each(const Scene& scene, std::span<const Camera> cameras,
                                              const PictureArrays& pictures, const RenderOptions& options);
  struct Impl;
  explicit Renderer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs
