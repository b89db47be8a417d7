// render_options.hpp - what both renderers make of the options before a frame.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "rgs/ablation.hpp"
#include "rgs/camera.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/page.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// RenderOptions with every choice made, once pipeline, scene and backend are known.
struct FrameSettings {
  std::array<float, 3> background;
  float near_plane;
  float far_plane;
  int sh_degree_limit;
  float low_pass;
  math::AntiAliasing anti_aliasing;
  math::Extent extent;
  math::DepthOrder depth_order;
  DepthMapping depth_mapping;
  int depth_bits;
  std::array<float, 2> depth_range;
  math::Exponent exponent;
  math::Exp exp;
  struct Cuda {
    PaperSteps::FrontEnd front_end;
    bool turbo;
    bool tensor_cores;
    int pixels_per_thread;
    bool deterministic;
    bool timings;
    bool stage_timings;
    bool count_pairs;
    bool asynchronous;
  } cuda;
};

/// Settings from options and a scene's declarations. `backend` is not automatic. Errors: bad_argument, naming the
/// illegal option.
Result<FrameSettings> resolve(const RenderOptions& options, const std::optional<Declarations>& declared,
                              Backend backend);
/// FrameStats::depth_resolution of a frame with `depth_bits`; 0 if that is 0. `declared`: by the scene.
double depth_resolution(const FrameSettings& settings, int depth_bits, const Camera& camera,
                        const std::optional<Declarations>& declared);

/// rgs::drawn_detail() if only `has_levels` is known of the scene.
Result<float> drawn_detail(const RenderOptions& options, bool has_levels);
/// `options` for drawing levels at this detail: above 0 with the anti-aliasing for which levels were fitted, unless
/// they name another.
RenderOptions with_levels(RenderOptions options, float detail_px);
/// The detail at which the host draws a scene that is not streamed: options.detail_px, or coarser for max_gaussians.
float chosen_detail(const Scene& scene, const Camera& camera, const RenderOptions& options);
/// The camera for the choice of pages. `z_near`: as the scene declares.
lod::Eye eye_of(const Camera& camera, const Origin& origin, float z_near);

/// bad_argument unless every span is empty or has the camera's pixels.
Status validate(const RenderTarget& target, const Camera& camera);

std::uint64_t pixels_of(const Camera& camera);
/// The arrays of the pictures from `first` on, each of `n_pixels`.
PictureArrays pictures_from(PictureArrays pictures, std::uint64_t first, std::uint64_t n_pixels);

/// For a scene whose means are relative to `origin`.
math::View<float> make_view(const Camera& camera, const Origin& origin, const FrameSettings& settings);

}  // namespace rgs::detail
