// render_options.cpp - the presets of RenderOptions, and which values are legal.
// SPDX-License-Identifier: Apache-2.0
#include "render_options.hpp"

#include <algorithm>
#include <cmath>

namespace rgs {

RenderOptions baseline_options() {
  RenderOptions o;
  o.extent = math::Extent::square;
  o.cuda.front_end = CudaOptions::FrontEnd::separate;
  o.cuda.pixels_per_thread = 1;
  return o;
}

RenderOptions paper_options(const std::optional<Declarations>& scene) {
  RenderOptions o;
  o.extent = math::Extent::ellipse;
  o.depth_order = math::DepthOrder::quantized;
  o.exponent = math::Exponent::folded;
  o.exp = math::Exp::paper;
  if (scene) {
    o.depth_range = {scene->z_near, scene->z_far};
    o.depth_mapping = scene->depth_mapping;
  }
  return o;
}

RenderOptions turbo_options() {
  RenderOptions o;
  o.exponent = math::Exponent::folded;
  o.cuda.turbo = true;
  return o;
}

namespace detail {

Status validate(const RenderOptions& o) {
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
      o.cuda.front_end > CudaOptions::FrontEnd::fused) {
    return refuse("an option has no such value");
  }
  if (o.cuda.pixels_per_thread != 1 && o.cuda.pixels_per_thread != 2) return refuse("pixels per thread are not 1 or 2");
  if (o.cuda.turbo && (o.extent != math::Extent::ellipse || o.depth_order != math::DepthOrder::exact ||
                       o.exponent != math::Exponent::folded || o.exp != math::Exp::exact)) {
    return refuse("turbo draws ellipses in exact order with folded exponents and exact exponentials only");
  }
  return {};
}

Status validate(const RenderTarget& t, const Camera& camera) {
  const std::size_t n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
  const auto fits = [n](std::size_t size, std::size_t channels) { return size == 0 || size == n * channels; };
  if (!fits(t.rgb.size(), 3) || !fits(t.alpha.size(), 1) || !fits(t.depth.size(), 1) || !fits(t.evaluated.size(), 1) ||
      !fits(t.blended.size(), 1)) {
    return make_error(Errc::bad_argument, Error::kNone, "a target's size is not that of the camera's image", n);
  }
  return {};
}

math::View<float> make_view(const Camera& camera, const RenderOptions& options) {
  double matrix[16];
  std::ranges::copy(row_major(camera.world_to_camera), matrix);
  return math::make_view<float>(matrix, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                                options.near_plane, options.far_plane);
}

}  // namespace detail
}  // namespace rgs
