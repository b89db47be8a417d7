// renderer.hpp - one frame of a scene seen by a camera.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/layout.hpp"
#include "rgs/math/options.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"
#include "rgs/streamed_scene.hpp"

namespace RGS_API rgs {

enum class Backend { automatic, cpu, cuda };

struct RendererOptions {
  Backend backend = Backend::automatic;
  int threads = 0;   ///< CPU threads, at most as many as the machine has, which 0 stands for
  bool simd = true;  ///< CPU: false runs the scalar definition in rgs::math pixel by pixel, the reference for all else
};

/// By which method a frame is made.
enum class Pipeline : std::uint8_t {
  /// On CUDA turbo. On the CPU the image's definition: ellipses, exact order, direct exponents, exact exponentials.
  automatic,
  baseline,  ///< the original 3DGS rasteriser: every setting of it, and on CUDA its kernels
  paper,     ///< the paper's, or what PaperSteps make of it
  /// Lists per tile of 32x32 pixels, each ordered exactly on its own, in place of a sort over the frame; deterministic
  /// by itself. Scenes of 2^25 Gaussians and more are drawn by the paper's kernels, in turbo's arithmetic. FrameStats:
  /// lists count as bin_ms, their order as sort_ms. The CPU has its arithmetic: ellipses, exact order, folded exponents.
  turbo,
};

/// Steps of the paper's method, each of which can be switched alone; the defaults are the paper. Pipeline::paper reads
/// them and no other. docs/format/RENDERING.md has the equations and the measured effect of each.
struct PaperSteps {
  enum class FrontEnd : std::uint8_t {
    separate,  ///< kernels of their own for projection, sum and duplication: the original
    fused,     ///< one kernel: the paper
  };
  math::Extent extent = math::Extent::ellipse;
  math::DepthOrder depth_order = math::DepthOrder::quantized;
  std::optional<DepthMapping> depth_mapping = std::nullopt;  ///< of the quantised key; absent: as declared, else linear
  /// Of the quantised key: 1..32, or 0 = 32 - ceil(log2 tiles); where the latter is below math::kMinDepthBits, as at
  /// 7680x4320, the order is exact (FrameStats::depth_bits says 0).
  int depth_bits = 0;
  /// Of the quantised key, depths outside share the end bins; absent: as declared, else 0.2 to 100.
  std::optional<std::array<float, 2>> depth_range = std::nullopt;
  math::Exponent exponent = math::Exponent::folded;
  math::Exp exp = math::Exp::paper;
  FrontEnd front_end = FrontEnd::fused;  ///< CUDA
  int pixels_per_thread = 2;             ///< CUDA: 1 (the original) or 2 (the paper)
  /// CUDA: same bytes on every run, whatever the order of the file: Gaussians that share a depth bin are drawn in tie order
  /// (docs/format/RENDERING.md), as they are by every other pipeline. Otherwise the fused front end lists them in the order in which
  /// its blocks happen to run, which is the paper's, and saves some time.
  bool deterministic = true;
};

/// Of Pipeline::turbo on CUDA; nothing else reads it, nor do scenes that the paper's kernels draw for it.
struct TurboOptions {
  /// Blends by matrix products in FP16, and in FP32 where depth or counts are wanted or the low-pass is below 0.1. These
  /// products stop a pixel at a transmittance of 2^-11 in place of 1e-4: up to an eighth of an 8-bit step of a white
  /// behind it is lost. docs/develop/KERNELS.md has what this changes.
  bool tensor_cores = true;
  /// CudaRenderer::render() waits for nothing and returns when the frame is queued; its counts are 0. A frame that needs
  /// more workspace than there is lacks tiles or all of them until the renderer's next call makes it again: see
  /// CudaRenderer::finish(). Renderer waits all the same.
  bool asynchronous = false;
};

/// What CudaRenderer measures of a frame. Renderer always waits and fills the times; the CPU counts and times always.
struct MeasureOptions {
  bool timings = false;  ///< wait for the frame and fill FrameStats' times
  /// Of the timings: those of the stages too, by events between the kernels, which cost the frame some time themselves.
  bool stage_timings = true;
  bool count_pairs = false;  ///< wait for the frame and count evaluated and blended pairs, at a cost in time
};

/// RenderOptions::detail_px of scenes with levels of detail: docs/develop/LEVELS.md has what it costs and saves.
inline constexpr float kDefaultDetailPx = 1;

/// What a frame shows, and how it is made.
struct RenderOptions {
  std::array<float, 3> background = {0, 0, 0};
  float near_plane = math::kNearPlane;  ///< Gaussians at camera z <= near_plane are not drawn
  float far_plane = 0;                  ///< Gaussians at camera z > far_plane are not drawn; 0 = no limit
  int sh_degree_limit = 3;              ///< higher SH degrees are ignored
  /// px^2 added to the projected covariance; absent: as the scene declares, or default_low_pass_px2() where another
  /// anti-aliasing is asked for than it declares.
  std::optional<float> low_pass = std::nullopt;
  std::optional<math::AntiAliasing> anti_aliasing = std::nullopt;  ///< absent: as the scene declares, else classic
  /// Of a scene with levels of detail, px: pages are drawn whose error is at most so many pixels (docs/format/FORMAT.md, "Error and cut"),
  /// with Mip-Splatting's opacities and a low-pass of 0.1 px^2, by which they were fitted, unless these options say otherwise.
  /// 0: its leaves, as a file without levels is drawn. Absent: kDefaultDetailPx; 0 for Pipeline::baseline, which draws leaves alone, and
  /// where contributions are counted. Other scenes ignore it.
  std::optional<float> detail_px = std::nullopt;
  Pipeline pipeline = Pipeline::automatic;
  PaperSteps paper = {};
  TurboOptions turbo = {};
  MeasureOptions measure = {};
};

/// `options` with what they leave to the scene filled in from what it declares: anti-aliasing (classic
/// if it declares none), low-pass, range and mapping of the paper's key. Renderers do this themselves with
/// Scene::declarations(); it is for drawing other scenes as this one.
RenderOptions with_declarations(RenderOptions options, const std::optional<Declarations>& declared);

/// The detail at which `scene` is drawn with `options`: 0 without levels, and where its leaves are. Errors: bad_argument (negative, not
/// finite, or baseline with another than 0).
Result<float> drawn_detail(const RenderOptions& options, const Scene& scene);
/// Pages of scene.levels() that a camera sees at a detail, in the order of their leaves. Errors: bad_argument without levels.
Result<std::vector<std::uint32_t>> drawn_pages(const Scene& scene, const Camera& camera, float detail_px);

/// The settings that options.pipeline stands for on a backend (not automatic), as steps: of baseline, where an ablation
/// starts; of turbo, its arithmetic.
PaperSteps steps_of(const RenderOptions& options, Backend backend);

/// FrameStats::depth_resolution from which programs warn: Gaussians nearer to each other than this share of their depth may
/// change places. On a trained scene a logarithmic key gives 66 dB at 1.3e-5, 57 dB here, 51 dB at 4e-4, where channels are
/// off by 121/255: docs/format/RENDERING.md, "Depth resolution".
inline constexpr double kCoarseDepthResolution = 1e-4;

/// What one frame cost. Counts are exact; times are wall clock of the calling thread, or of the device's stream.
struct FrameStats {
  double project_ms = 0;  ///< cull, project, colour; the whole fused front end
  double sort_ms = 0;     ///< order by depth, on CUDA by tile and depth; of turbo that of the lists that are not long
  double bin_ms = 0;      ///< lists of Gaussians per tile; on CUDA pairs of the separate front end, and tile ranges
  /// Pixels; of turbo also what its long lists take longer, which are ordered and blended beside the others.
  double blend_ms = 0;
  double total_ms = 0;
  std::uint64_t gaussians = 0;  ///< in the scene, or in the pages that are drawn
  std::uint64_t pages = 0;      ///< of a scene with levels of detail that are drawn; 0 where it is drawn without
  std::uint64_t visible = 0;    ///< listed in at least one tile
  std::uint64_t instances = 0;  ///< (tile, Gaussian) pairs
  std::uint64_t evaluated = 0;  ///< (pixel, Gaussian) pairs that pixels went through before they stopped
  std::uint64_t blended = 0;    ///< of these, pairs that contributed
  std::uint64_t bytes = 0;      ///< workspace held after the frame
  int depth_bits = 0;           ///< of the quantised key that was used, 0 for exact order
  int key_bits = 0;             ///< CUDA: bits that were sorted, tile and depth
  /// Of the quantised key: the width of the widest bin of the depth range, relative to the depth where it begins. If the
  /// middle of the box that the scene declares lies in front of the camera and outside the range, at least that of the end
  /// bin that it falls in, which reaches to the box's end. 0: exact order. Steps of FP32 itself, 6e-8, are not counted.
  double depth_resolution = 0;
  StreamStats stream;  ///< of a StreamedScene
};

/// Memory of a device. Copies share it; the last one waits for the device and frees it.
struct DeviceBlock {
  std::shared_ptr<void> data;
  int device = 0;  ///< its number among those of CUDA
};

/// Renders frames. Holds the workspace, which grows and is reused; one Renderer serves one thread at a time, and any
/// number of Renderers may share a Scene.
class Renderer {
 public:
  /// Errors: bad_argument (negative thread count), unavailable (the backend is not built or no device answers),
  /// device_out_of_memory, device_failed. A moved-from Renderer may only be destroyed or assigned to.
  static Result<Renderer> create(const RendererOptions& options = {});

  Renderer(Renderer&&) noexcept;
  Renderer& operator=(Renderer&&) noexcept;
  ~Renderer();

  /// Brings the scene to where it is drawn, which the first render() does otherwise: CUDA uploads it, of a file with levels all
  /// pages, and decodes on the device what Scene::open() has left in its file; the CPU makes its FP32 arrays. Errors: those of Scene::view() and
  /// DeviceScene::upload().
  Status prepare(const Scene& scene);

  /// Fills `target` and returns what it cost. Errors: bad_camera (see validate()), bad_argument (an option, the size
  /// of a target span, or contributions asked of CUDA), limit_exceeded (2^32 (tile, Gaussian) pairs or more, on CUDA 2^31), device_out_of_memory,
  /// device_failed; of a scene that has to be brought there first, those of prepare().
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options = {});

  /// Pictures of several cameras of one size, each as render() gives it. On CUDA several are on their way at once, which makes the most of
  /// small ones. Complete on return; times of stages are those of a single picture alone. Errors: those of render(); bad_argument
  /// (sizes that differ, an array that is not in the device's memory), unavailable (arrays on a device, drawn by the CPU).
  Result<std::vector<FrameStats>> render_all(const Scene& scene, std::span<const Camera> cameras,
                                             const PictureArrays& pictures, const RenderOptions& options = {});

  /// The same of what is there of a streamed scene: the frame waits for no input, and FrameStats::stream says what it lacks. Errors: also
  /// unavailable (CUDA, of a pool without StreamPoolOptions::device_memory; the CPU, of one with it).
  Result<FrameStats> render(const StreamedScene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options = {});
  /// Waits until nothing is missing that this view wants, and the file's table of pages is read and checked; then render() gives the
  /// picture of the whole file, byte for byte. False: `seconds` are over, or the pool has no room for the rest of the view. Errors: those of
  /// StreamedScene::status() that keep the view from being complete, and of render().
  Result<bool> refine(const StreamedScene& scene, const Camera& camera, double seconds,
                      const RenderOptions& options = {});

  /// Memory of the device that is drawn on, for PictureArrays. Errors: unavailable (the CPU has none), bad_argument (0 bytes),
  /// device_out_of_memory, device_failed.
  Result<DeviceBlock> allocate_on_device(std::uint64_t bytes) const;

  Backend backend() const;           ///< the backend in use, never automatic
  const char* backend_name() const;  ///< e.g. "cpu AVX3_SPR", "cpu scalar"

 private:
  Result<std::vector<FrameStats>> render_each(const Scene& scene, std::span<const Camera> cameras,
                                              const PictureArrays& pictures, const RenderOptions& options);
  struct Impl;
  explicit Renderer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs
