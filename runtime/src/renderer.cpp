// renderer.cpp - checks what the caller asked for and hands the frame to the machine that draws it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/renderer.hpp"

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include "reference_renderer.hpp"

namespace rgs {
namespace {

constexpr auto kNoOffset = Error::kNone;

Status check(const RenderOptions& o) {
  const auto refuse = [](const char* what) { return fail(Errc::bad_argument, kNoOffset, what); };
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
      o.exponent > math::Exponent::folded || o.exp > math::Exp::zero_mean) {
    return refuse("an option has no such value");
  }
  return {};
}

Status check(const RenderTarget& t, const Camera& camera) {
  const std::size_t n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
  const auto fits = [n](std::size_t size, std::size_t channels) { return size == 0 || size == n * channels; };
  if (!fits(t.rgb.size(), 3) || !fits(t.alpha.size(), 1) || !fits(t.depth.size(), 1) || !fits(t.evaluated.size(), 1) ||
      !fits(t.blended.size(), 1)) {
    return fail(Errc::bad_argument, kNoOffset, "a target's size is not that of the camera's image", n);
  }
  return {};
}

}  // namespace

struct Renderer::Impl {
  explicit Impl(const RendererOptions& options)
      : reference(options.threads, options.simd), name(std::string("cpu ") + reference.name()) {}
  detail::ReferenceRenderer reference;
  std::string name;
};

Renderer::Renderer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Renderer::Renderer(Renderer&&) noexcept = default;
Renderer& Renderer::operator=(Renderer&&) noexcept = default;
Renderer::~Renderer() = default;

Result<Renderer> Renderer::create(const RendererOptions& options) {
  if (options.threads < 0) return fail(Errc::bad_argument, kNoOffset, "the number of threads is negative");
  if (options.backend == Backend::cuda) {
    return fail(Errc::unavailable, kNoOffset, "this build has no CUDA renderer; use the CPU backend");
  }
  return Renderer(std::make_unique<Impl>(options));
}

Result<FrameStats> Renderer::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                    const RenderOptions& options) {
  if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
  if (const auto ok = check(options); !ok) return tl::unexpected(ok.error());
  if (const auto ok = check(target, camera); !ok) return tl::unexpected(ok.error());
  return impl_->reference.render(scene.view(), camera, target, options);
}

Backend Renderer::backend() const {
  return Backend::cpu;
}
const char* Renderer::backend_name() const {
  return impl_->name.c_str();
}

}  // namespace rgs
