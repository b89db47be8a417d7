// render_options.cpp - turns options and declarations into a frame's settings, and checks them.
// SPDX-License-Identifier: Apache-2.0
#include "render_options.hpp"

#include <algorithm>
#include <cmath>
#include <glm/matrix.hpp>
#include <limits>

#include "rgs/camera_view.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"

namespace rgs {

static_assert(default_low_pass_px2(AaMode::classic) == math::kLowPass, "the reference's low-pass is that of 3DGS");

RenderOptions with_declarations(RenderOptions options, const std::optional<Declarations>& declared) {
  const Declarations d = declared.value_or(Declarations());  // the default is the original's
  const bool is_mip = d.aa_mode == AaMode::mip_splatting;
  if (!options.anti_aliasing) {
    options.anti_aliasing = is_mip ? math::AntiAliasing::mip_splatting : math::AntiAliasing::classic;
  }
  if (!options.low_pass) {
    // A low-pass belongs to its mode: a mode other than the declared one gets its default.
    const auto drawn =
        options.anti_aliasing == math::AntiAliasing::mip_splatting ? AaMode::mip_splatting : AaMode::classic;
    options.low_pass = drawn == d.aa_mode ? d.low_pass_px2 : default_low_pass_px2(drawn);
  }
  if (!options.paper.depth_mapping) options.paper.depth_mapping = d.depth_mapping;
  if (!options.paper.depth_range) options.paper.depth_range = {d.z_near, d.z_far};
  return options;
}

Result<float> detail::drawn_detail(const RenderOptions& options, bool has_levels) {
  const float detail = options.detail_px.value_or(options.pipeline == Pipeline::baseline ? 0 : kDefaultDetailPx);
  if (!(detail >= 0 && std::isfinite(detail))) {
    return make_error(Errc::bad_argument, Error::kNone, "the detail is negative or not finite");
  }
  if (options.frame_ms && !(*options.frame_ms > 0)) {
    return make_error(Errc::bad_argument, Error::kNone, "the time of a frame is not above 0");
  }
  if (!has_levels) return 0.0F;
  if ((detail > 0 || options.max_gaussians || options.frame_ms) && options.pipeline == Pipeline::baseline) {
    return make_error(
        Errc::bad_argument, Error::kNone,
        "baseline draws the leaves alone: set detail 0 without a limit of Gaussians or time, or another pipeline");
  }
  return detail;
}

Result<float> drawn_detail(const RenderOptions& options, const Scene& scene) {
  return detail::drawn_detail(options, scene.levels() != nullptr || scene.is_streamed());
}

RenderOptions detail::with_levels(RenderOptions options, float detail_px) {
  options.detail_px = detail_px;
  if (detail_px > 0 && !options.anti_aliasing) {
    options.anti_aliasing = math::AntiAliasing::mip_splatting;
    if (!options.low_pass) options.low_pass = default_low_pass_px2(AaMode::mip_splatting);
  }
  return options;
}

lod::Eye detail::eye_of(const Camera& camera, const Origin& origin, float z_near) {
  const glm::dmat4 camera_to_world = glm::inverse(camera.world_to_camera);
  lod::Eye eye;
  for (int k = 0; k < 3; ++k) {
    eye.position[static_cast<std::size_t>(k)] = camera_to_world[3][k] - origin[static_cast<std::size_t>(k)];
  }
  eye.focal_px = math::pixels_per_radian(view_of(camera, origin, 0.0, 0.0));
  eye.z_near = static_cast<double>(z_near);
  // Parallel rays have so many pixels a world unit at every distance; no page is as far away as this.
  if (constexpr double kFar = 1e30; camera.model == CameraModel::orthographic) eye.focal_px *= kFar, eye.z_near = kFar;
  return eye;
}

float detail::chosen_detail(const Scene& scene, const Camera& camera, const RenderOptions& options) {
  const PagedFile* const file = scene.levels();
  if (file == nullptr || !options.max_gaussians) return *options.detail_px;
  const lod::Eye eye = eye_of(camera, scene.origin(), scene.declarations()->z_near);
  return lod::finest_detail(file->pages(), eye, *options.detail_px, *options.max_gaussians, file->n_present())
      .detail_px;
}

Result<std::vector<std::uint32_t>> drawn_pages(const Scene& scene, const Camera& camera, float detail_px) {
  const PagedFile* const file = scene.levels();
  if (file == nullptr) return make_error(Errc::bad_argument, Error::kNone, "the scene has no levels of detail");
  const lod::Eye eye = detail::eye_of(camera, scene.origin(), scene.declarations()->z_near);
  return detail::guard_memory([&]() -> Result<std::vector<std::uint32_t>> {
    return lod::drawn_pages(file->pages(), eye, detail_px, file->n_present());
  });
}

PaperSteps steps_of(const RenderOptions& options, Backend backend) {
  PaperSteps steps;
  if (options.pipeline == Pipeline::paper) return options.paper;
  steps.depth_order = math::DepthOrder::exact;
  steps.exp = math::Exp::exact;
  if (options.pipeline == Pipeline::baseline) {
    steps.extent = math::Extent::square;
    steps.exponent = math::Exponent::direct;
    steps.front_end = PaperSteps::FrontEnd::separate;
    steps.pixels_per_thread = 1;
  }
  if (options.pipeline == Pipeline::automatic && backend == Backend::cpu) steps.exponent = math::Exponent::direct;
  return steps;
}

namespace detail {

namespace {

Status validate(const FrameSettings& o) {
  const auto refuse = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
  if (!std::all_of(o.background.begin(), o.background.end(), [](float v) { return std::isfinite(v); })) {
    return refuse("the background is not finite");
  }
  if (!(o.near_plane >= 0 && std::isfinite(o.near_plane))) return refuse("the near plane is negative or not finite");
  if (!(o.far_plane == 0 || o.far_plane > o.near_plane))
    return refuse("the far plane does not lie behind the near plane");
  if (o.sh_degree_limit < 0 || o.sh_degree_limit > kMaxShDegree) return refuse("the SH degree limit is not 0..3");
  if (!(o.low_pass >= 0 && std::isfinite(o.low_pass))) return refuse("the low-pass is negative or not finite");
  if (o.depth_bits < 0 || o.depth_bits > 32) return refuse("the depth key's bits are not 0..32");
  if (!(o.depth_range[0] > 0 && o.depth_range[0] < o.depth_range[1] && std::isfinite(o.depth_range[1]))) {
    return refuse("the depth key's range is empty, not positive or not finite");
  }
  if (o.anti_aliasing > math::AntiAliasing::mip_splatting || o.extent > math::Extent::ellipse ||
      o.depth_order > math::DepthOrder::quantized ||
      (o.depth_mapping != DepthMapping::linear && o.depth_mapping != DepthMapping::logarithmic) ||
      o.exponent > math::Exponent::folded || o.exp > math::Exp::zero_mean ||
      o.cuda.front_end > PaperSteps::FrontEnd::fused) {
    return refuse("an option has an unknown value");
  }
  if (o.cuda.pixels_per_thread != 1 && o.cuda.pixels_per_thread != 2) return refuse("pixels per thread are not 1 or 2");
  return {};
}

}  // namespace

Result<FrameSettings> resolve(const RenderOptions& options, const std::optional<Declarations>& declared,
                              Backend backend) {
  if (options.pipeline > Pipeline::turbo) {
    return make_error(Errc::bad_argument, Error::kNone, "the pipeline is unknown");
  }
  RenderOptions o = options;
  o.paper = steps_of(options, backend);
  o = with_declarations(o, declared);
  const PaperSteps& s = o.paper;
  const bool is_turbo =
      backend == Backend::cuda && (o.pipeline == Pipeline::automatic || o.pipeline == Pipeline::turbo);
  const FrameSettings settings{
      .background = o.background,
      .near_plane = o.near_plane,
      .far_plane = o.far_plane,
      .sh_degree_limit = o.sh_degree_limit,
      .low_pass = *o.low_pass,
      .anti_aliasing = *o.anti_aliasing,
      .extent = s.extent,
      .depth_order = s.depth_order,
      .depth_mapping = *s.depth_mapping,
      .depth_bits = s.depth_bits,
      .depth_range = *s.depth_range,
      .exponent = s.exponent,
      .exp = s.exp,
      .cuda = {.front_end = s.front_end,
               .turbo = is_turbo,
               .tensor_cores = is_turbo && o.turbo.tensor_cores,
               .pixels_per_thread = s.pixels_per_thread,
               .deterministic = s.deterministic,
               .timings = o.measure.timings,
               .stage_timings = o.measure.stage_timings,
               .count_pairs = o.measure.count_pairs,
               .asynchronous = is_turbo && o.turbo.asynchronous},
  };
  if (const auto ok = validate(settings); !ok) return tl::unexpected(ok.error());
  return settings;
}

double depth_resolution(const FrameSettings& settings, int depth_bits, const Camera& camera,
                        const std::optional<Declarations>& declared) {
  if (depth_bits == 0) return 0;
  const double near = static_cast<double>(settings.depth_range[0]), far = static_cast<double>(settings.depth_range[1]);
  const double bins = std::exp2(depth_bits) - 1;  // as make_depth_quantizer() divides the range
  // Bins of equal width are coarsest, relative to depth, where they start.
  const double step = settings.depth_mapping == DepthMapping::logarithmic ? std::expm1(std::log(far / near) / bins)
                                                                          : (far - near) / bins / near;
  if (!declared) return step;
  const SceneBounds box = declared_bounds(*declared);
  if (box.low == box.high) return step;  // only files' declarations have a box
  const auto view = view_of(camera, kNoOrigin, 0.0, 0.0);
  double low = std::numeric_limits<double>::infinity(), high = -low, middle = 0;
  for (int corner = 0; corner < 8; ++corner) {
    const glm::dvec3 at(corner & 1 ? box.high.x : box.low.x, corner & 2 ? box.high.y : box.low.y,
                        corner & 4 ? box.high.z : box.low.z);
    const double z = see(view, at).depth;
    low = std::min(low, z), high = std::max(high, z), middle += z / 8;
  }
  const double drawn = static_cast<double>(settings.near_plane);
  if (middle > far) return std::max(step, high / far - 1);
  if (middle > drawn && middle < near) return std::max(step, near / std::max(low, drawn) - 1);
  return step;
}

Status validate(const RenderTarget& t, const Camera& camera) {
  const std::size_t n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
  const auto fits = [n](std::size_t size, std::size_t channels) { return size == 0 || size == n * channels; };
  if (!fits(t.rgb.size(), 3) || !fits(t.alpha.size(), 1) || !fits(t.depth.size(), 1) || !fits(t.evaluated.size(), 1) ||
      !fits(t.blended.size(), 1)) {
    return make_error(Errc::bad_argument, Error::kNone, "a target's size differs from the camera's image", n);
  }
  return {};
}

std::uint64_t pixels_of(const Camera& camera) {
  return static_cast<std::uint64_t>(camera.width) * static_cast<std::uint64_t>(camera.height);
}

PictureArrays pictures_from(PictureArrays p, std::uint64_t first, std::uint64_t n_pixels) {
  const auto move = [&](auto*& data, std::uint64_t n) {
    if (data != nullptr) data += first * n;
  };
  move(p.rgb, 3 * n_pixels);
  move(p.codes, 3 * n_pixels);
  move(p.alpha, n_pixels);
  move(p.depth, n_pixels);
  return p;
}

math::View<float> make_view(const Camera& camera, const Origin& origin, const FrameSettings& settings) {
  return view_of(camera, origin, settings.near_plane, settings.far_plane);
}

}  // namespace detail
}  // namespace rgs
