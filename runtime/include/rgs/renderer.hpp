// renderer.hpp - one frame of a scene seen by a camera.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>

#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/layout.hpp"
#include "rgs/math/options.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace RGS_API rgs {

enum class Backend { automatic, cpu, cuda };

struct RendererOptions {
  Backend backend = Backend::automatic;
  int threads = 0;   ///< CPU threads, at most as many as the machine has, which 0 stands for
  bool simd = true;  ///< CPU: false runs the scalar definition in rgs::math pixel by pixel, the reference for all else
};

/// How the CUDA renderer makes a frame. None of it changes the image beyond rounding; the CPU ignores it.
struct CudaOptions {
  enum class FrontEnd : std::uint8_t {
    separate,  ///< kernels of their own for projection, sum and duplication: the original
    fused,     ///< one kernel: the paper
  };
  FrontEnd front_end = FrontEnd::fused;
  /// Lists per tile of 32x32 pixels, each ordered exactly on its own, in place of a sort over the frame; deterministic by
  /// itself. Takes the arithmetic of turbo_options(), and the place of front_end and pixels_per_thread. Scenes of 2^25
  /// Gaussians and more are drawn by the other kernels. FrameStats: lists count as bin_ms, their order as sort_ms.
  bool turbo = false;
  /// Of turbo: blends by matrix products in FP16, and in FP32 where depth or counts are wanted or low_pass < 0.1. Stops
  /// a pixel at a transmittance of 2^-11 in place of 1e-4. docs/KERNELS.md has what this changes.
  bool tensor_cores = true;
  int pixels_per_thread = 2;  ///< 1 (the original) or 2 (the paper)
  /// Same bytes on every run: Gaussians that share a depth bin keep the order of the scene. Otherwise the fused front
  /// end lists them in the order in which its blocks happen to run.
  bool deterministic = false;
  bool timings = false;  ///< wait for the frame and fill FrameStats' times
  /// Of the timings: those of the stages too, by events between the kernels, which cost the frame some time themselves.
  bool stage_timings = true;
  bool count_pairs = false;  ///< wait for the frame and count evaluated and blended pairs, at a cost in time
  /// Turbo: the frame's kernels as one CUDA graph, which is captured anew for every frame. Same bytes. Its stages are not
  /// timed, and the host, where it waits for the counts, waits for the end of the frame.
  bool graph = false;
  /// Turbo: CudaRenderer::render() waits for nothing and returns when the frame is queued; its counts are 0. A frame
  /// that needs more workspace than there is lacks tiles or all of them until the renderer's next call makes it again:
  /// see CudaRenderer::finish(). Renderer waits all the same.
  bool asynchronous = false;
};

/// What a frame shows and by which arithmetic. The defaults are the original 3DGS rasteriser, only with the tighter
/// tile coverage; docs/RENDERING.md has the equations and the measured effect of each option.
struct RenderOptions {
  std::array<float, 3> background = {0, 0, 0};
  float near_plane = math::kNearPlane;  ///< Gaussians at camera z <= near_plane are not drawn
  float far_plane = 0;                  ///< Gaussians at camera z > far_plane are not drawn; 0 = no limit
  int sh_degree_limit = 3;              ///< higher SH degrees are ignored
  float low_pass = math::kLowPass;      ///< px^2 added to the projected covariance; Mip-Splatting models use 0.1
  math::AntiAliasing anti_aliasing = math::AntiAliasing::classic;
  math::Extent extent = math::Extent::ellipse;
  math::DepthOrder depth_order = math::DepthOrder::exact;
  DepthMapping depth_mapping = DepthMapping::linear;  ///< of the quantised key
  /// Of the quantised key: 1..32, or 0 = 32 - ceil(log2 tiles); where the latter is below math::kMinDepthBits, as at
  /// 7680x4320, the order is exact (FrameStats::depth_bits says 0).
  int depth_bits = 0;
  std::array<float, 2> depth_range = {0.2F, 100};  ///< of the quantised key, depths outside share the end bins
  math::Exponent exponent = math::Exponent::direct;
  math::Exp exp = math::Exp::exact;
  CudaOptions cuda = {};
};

/// The original 3DGS rasteriser: every option of it, and on CUDA its kernels.
RenderOptions baseline_options();
/// The paper's: tiles by ellipse, 32-bit keys, folded exponent of two pixels, approximate exponential. Range and
/// mapping of the key are what `scene` declares, if it is given.
RenderOptions paper_options(const std::optional<Declarations>& scene = std::nullopt);
/// The fastest: ellipse, exact order, folded exponent, the hardware's exponential; CudaOptions::turbo.
RenderOptions turbo_options();

/// What one frame cost. Counts are exact; times are wall clock of the calling thread, or of the device's stream.
struct FrameStats {
  double project_ms = 0;  ///< cull, project, colour; the whole fused front end
  double sort_ms = 0;     ///< order by depth, on CUDA by tile and depth
  double bin_ms = 0;      ///< lists of Gaussians per tile; on CUDA pairs of the separate front end, and tile ranges
  double blend_ms = 0;    ///< pixels
  double total_ms = 0;
  std::uint64_t gaussians = 0;  ///< in the scene
  std::uint64_t visible = 0;    ///< listed in at least one tile
  std::uint64_t instances = 0;  ///< (tile, Gaussian) pairs
  std::uint64_t evaluated = 0;  ///< (pixel, Gaussian) pairs that pixels went through before they stopped
  std::uint64_t blended = 0;    ///< of these, pairs that contributed
  std::uint64_t bytes = 0;      ///< workspace held after the frame
  int depth_bits = 0;           ///< of the quantised key that was used, 0 for exact order
  int key_bits = 0;             ///< CUDA: bits that were sorted, tile and depth
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

  /// Fills `target` and returns what it cost. Errors: bad_camera (see validate()), bad_argument (an option, the size
  /// of a target span, or contributions asked of CUDA), limit_exceeded (2^32 (tile, Gaussian) pairs or more, on CUDA 2^31), device_out_of_memory,
  /// device_failed.
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  /// With default_options().
  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target);

  /// What is drawn where nothing else is asked for: turbo_options() on CUDA, RenderOptions() on the CPU.
  RenderOptions default_options() const;
  Backend backend() const;           ///< the backend in use, never automatic
  const char* backend_name() const;  ///< e.g. "cpu AVX3_SPR", "cpu scalar"

 private:
  struct Impl;
  explicit Renderer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs
