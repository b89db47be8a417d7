// renderer.cpp - checks what the caller asked for and hands the frame to the machine that draws it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/renderer.hpp"

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "cuda/cuda_backend.hpp"
#include "render_options.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

struct Renderer::Impl {
  std::optional<detail::ReferenceRenderer> reference;  // one of the two
  std::optional<detail::CudaBackend> cuda;
  std::string name;
  // On the CPU, pages of a scene with levels of detail, as the last frame drew them: kept while they stay the same.
  struct Cut {
    std::uint64_t of = 0;  // Scene::identity()
    std::vector<std::uint32_t> pages = {};
    Scene scene = {};
  } cut;

  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
};

Renderer::Renderer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Renderer::Renderer(Renderer&&) noexcept = default;
Renderer& Renderer::operator=(Renderer&&) noexcept = default;
Renderer::~Renderer() = default;

Result<Renderer> Renderer::create(const RendererOptions& options) {
  return detail::guard_memory([&]() -> Result<Renderer> {
    if (options.threads < 0) return make_error(Errc::bad_argument, Error::kNone, "the number of threads is negative");
    auto impl = std::make_unique<Impl>();
    if (options.backend != Backend::cpu) {
      auto cuda = detail::CudaBackend::create();
      if (cuda) {
        impl->cuda.emplace(std::move(*cuda));
        impl->name = impl->cuda->name();
        return Renderer(std::move(impl));
      }
      if (options.backend == Backend::cuda) return tl::unexpected(cuda.error());
    }
    impl->reference.emplace(options.threads, options.simd);
    impl->name = std::string("cpu ") + impl->reference->name();
    return Renderer(std::move(impl));
  });
}

Status Renderer::prepare(const Scene& scene) {
  if (impl_->cuda) return detail::guard_memory([&] { return impl_->cuda->prepare(scene); });
  const auto view = scene.view();
  if (!view) return tl::unexpected(view.error());
  return {};
}

Result<FrameStats> Renderer::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                    const RenderOptions& options) {
  if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
  RenderOptions drawn = options;
  if (!drawn.detail_px && !target.contributions.empty()) drawn.detail_px = 0;
  const auto detail = drawn_detail(drawn, scene);
  if (!detail) return tl::unexpected(detail.error());
  drawn = detail::with_levels(drawn, *detail);
  if (*detail > 0 && !target.contributions.empty()) {
    return make_error(Errc::bad_argument, Error::kNone, "contributions are counted of the leaves alone: detail 0");
  }
  // A device has all pages and chooses among them itself.
  if (*detail == 0 || impl_->cuda) return impl_->render(scene, camera, target, drawn);
  return detail::guard_memory([&]() -> Result<FrameStats> {
    auto pages = drawn_pages(scene, camera, *detail);
    if (!pages) return tl::unexpected(pages.error());
    Impl::Cut& cut = impl_->cut;
    if (cut.of != scene.identity() || cut.pages != *pages) {
      cut = {};
      auto chosen = scene.pages(*pages);
      if (!chosen) return tl::unexpected(chosen.error());
      cut = {scene.identity(), *std::move(pages), *std::move(chosen)};
    }
    auto stats = impl_->render(cut.scene, camera, target, drawn);
    if (stats) stats->pages = cut.pages.size();
    return stats;
  });
}

// A scene without levels, or the leaves of one with them; on CUDA any scene.
Result<FrameStats> Renderer::Impl::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                          const RenderOptions& options) {
  const Backend backend = cuda ? Backend::cuda : Backend::cpu;
  const auto settings = detail::resolve(options, scene.declarations(), backend);
  if (!settings) return tl::unexpected(settings.error());
  if (const auto ok = detail::validate(target, camera); !ok) return tl::unexpected(ok.error());
  if (!target.contributions.empty()) {
    if (cuda) return make_error(Errc::bad_argument, Error::kNone, "contributions are counted by the CPU renderer only");
    if (target.contributions.size() != scene.size())
      return make_error(Errc::bad_argument, Error::kNone, "the contributions' size is not that of the scene",
                        scene.size(), target.contributions.size());
  }
  auto stats = cuda ? cuda->render(scene, camera, target, with_declarations(options, scene.declarations()))
                    : scene.view().and_then(
                          [&](const SceneView& view) { return reference->render(view, camera, target, *settings); });
  // Here also for CUDA, where a scene of FP32 arrays no longer knows what it declares.
  if (stats) {
    stats->depth_resolution = detail::depth_resolution(*settings, stats->depth_bits, camera, scene.declarations());
  }
  return stats;
}

Backend Renderer::backend() const {
  return impl_->cuda ? Backend::cuda : Backend::cpu;
}
const char* Renderer::backend_name() const {
  return impl_->name.c_str();
}

}  // namespace rgs
