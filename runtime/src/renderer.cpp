// renderer.cpp - checks the arguments of a frame and passes it to the backend.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/renderer.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <future>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "cpu/reference_renderer.hpp"
#include "cuda/cuda_backend.hpp"
#include "frame_budget.hpp"
#include "render_options.hpp"
#include "rgs/guard_memory.hpp"
#include "stream/streamed_state.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kMaxDrawn = std::uint64_t{1} << 31;

tl::unexpected<Error> too_many(std::uint64_t n) {
  return make_error(Errc::limit_exceeded, Error::kNone, "more Gaussians than the renderer can index", kMaxDrawn - 1, n);
}

}  // namespace

struct Renderer::Impl {
  std::optional<detail::ReferenceRenderer> reference;  // null if CUDA draws
  std::optional<detail::CudaBackend> cuda;             // of the first device
  std::vector<detail::CudaBackend> others;             // of the further devices
  std::string name;
  std::vector<float> scratch;  // for a picture whose codes alone are wanted
  detail::FrameBudget budget;  // of RenderOptions::frame_ms
  std::uint64_t n_cut = 0;     // Gaussians of the last frame's cut, in and out of view; 0 without levels

  RenderOptions within_time(RenderOptions options) const {
    if (options.frame_ms)
      options.max_gaussians = std::min(options.max_gaussians.value_or(pages::kNoLimit), budget.max_gaussians());
    return options;
  }

  // Identifies this renderer's view of streamed scenes.
  std::uint64_t identity = next_identity();

  Result<FrameStats> render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                            const RenderOptions& options);
  Result<FrameStats> draw_on_cpu(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                 const RenderOptions& options, const detail::FrameSettings& settings);
  Result<FrameStats> render(const detail::StreamFrame& frame, const Scene& scene, const Camera& camera,
                            const RenderTarget& target, const RenderOptions& options);
  Result<std::vector<FrameStats>> render_on_device(const Scene& scene, std::span<const Camera> cameras,
                                                   const PictureArrays& pictures, const RenderOptions& options);
  // f(device, k) of the first n devices, all at once; the results in this order.
  template <class F>
  auto on_devices(std::size_t n, const F& f) {
    using Done = decltype(f(*cuda, n));
    const auto on_device = [this, &f](std::size_t k) -> Done {
      return detail::guard_memory([&] { return f(k == 0 ? *cuda : others[k - 1], k); });
    };
    std::vector<Done> all;
    std::vector<std::future<Done>> waited_for;  // also after an exception
    all.reserve(n), waited_for.reserve(n);
    // One for which no thread can be started follows the others.
    for (std::size_t k = 1; k < n; ++k)
      waited_for.push_back(std::async(std::launch::async | std::launch::deferred, on_device, k));
    all.push_back(on_device(0));
    for (auto& other : waited_for) all.push_back(other.get());
    return all;
  }
  Result<detail::StreamRule> rule_of(const Scene& scene, const Camera& camera, const RenderOptions& options) const;
  std::uint64_t n_missing(const Scene& scene, const Camera& camera, const RenderOptions& options,
                          float detail_px) const;
  static std::uint64_t next_identity() {
    static std::atomic<std::uint64_t> last{0};
    return ++last;
  }
};

Renderer::Renderer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Renderer::Renderer(Renderer&&) noexcept = default;
Renderer& Renderer::operator=(Renderer&&) noexcept = default;
Renderer::~Renderer() = default;

Result<Renderer> Renderer::create(const RendererOptions& options) {
  return detail::guard_memory([&]() -> Result<Renderer> {
    if (options.threads < 0) return make_error(Errc::bad_argument, Error::kNone, "the number of threads is negative");
    const std::vector<int>& devices = options.devices;
    if (!devices.empty() && options.backend == Backend::cpu)
      return make_error(Errc::bad_argument, Error::kNone, "devices are CUDA's: name none, or use Backend::cuda");
    if (std::ranges::any_of(devices, [](int device) { return device < 0; }))
      return make_error(Errc::bad_argument, Error::kNone, "the number of a device is negative: they count from 0");
    auto impl = std::make_unique<Impl>();
    if (options.backend != Backend::cpu) {
      auto cuda = detail::CudaBackend::create(devices.empty() ? std::nullopt : std::optional(devices.front()));
      if (!cuda && (options.backend == Backend::cuda || !devices.empty())) return tl::unexpected(cuda.error());
      if (cuda) {
        impl->cuda.emplace(std::move(*cuda));
        impl->name = impl->cuda->name();
        impl->others.reserve(devices.size());
        for (std::size_t k = 1; k < devices.size(); ++k) {
          auto other = detail::CudaBackend::create(devices[k]);
          if (!other) return tl::unexpected(other.error());
          impl->others.push_back(std::move(*other));
        }
        return Renderer(std::move(impl));
      }
    }
    impl->reference.emplace(options.threads, options.simd);
    impl->name = std::string("cpu ") + impl->reference->name();
    return Renderer(std::move(impl));
  });
}

Status Renderer::prepare(const Scene& scene) {
  if (impl_->cuda) {
    return detail::guard_memory([&]() -> Status {
      const auto prepare_on = [&scene](detail::CudaBackend& device, std::size_t) { return device.prepare(scene); };
      for (const Status& ok : impl_->on_devices(1 + impl_->others.size(), prepare_on)) {
        if (!ok) return ok;
      }
      return {};
    });
  }
  const auto view = scene.view();
  if (!view) return tl::unexpected(view.error());
  return {};
}

Result<FrameStats> Renderer::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                    const RenderOptions& options) {
  if (!options.frame_ms) return draw(scene, camera, target, options);
  const auto begin = std::chrono::steady_clock::now();
  auto stats = draw(scene, camera, target, impl_->within_time(options));
  const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - begin;
  if (stats && impl_->n_cut > 0) impl_->budget.drew(took.count(), *options.frame_ms, impl_->n_cut);
  return stats;
}

Result<FrameStats> Renderer::draw(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                  const RenderOptions& options) {
  if (scene.is_streamed()) return render_streamed(scene, camera, target, options);
  if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
  RenderOptions drawn = options;
  if (!drawn.detail_px && !target.contributions.empty()) drawn.detail_px = 0;
  const auto detail = drawn_detail(drawn, scene);
  if (!detail) return tl::unexpected(detail.error());
  drawn = detail::with_levels(drawn, *detail);
  if ((*detail > 0 || (drawn.max_gaussians && scene.levels() != nullptr)) && !target.contributions.empty()) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "contributions are counted for the leaves alone: set detail 0 without a limit of Gaussians");
  }
  return detail::guard_memory([&]() -> Result<FrameStats> {
    auto stats = impl_->render(scene, camera, target, drawn);
    if (!stats) return stats;
    impl_->n_cut = scene.levels() != nullptr ? stats->gaussians : 0;
    stats->stream.pages_missing = impl_->n_missing(scene, camera, drawn, stats->detail_px);
    return stats;
  });
}

Result<std::vector<FrameStats>> Renderer::render_all(const Scene& scene, std::span<const Camera> cameras,
                                                     const PictureArrays& pictures, const RenderOptions& options) {
  if (pictures.on_device && !impl_->cuda) {
    return make_error(Errc::unavailable, Error::kNone,
                      "only CUDA draws pictures into device memory: use Backend::cuda");
  }
  if (pictures.on_device && !impl_->others.empty()) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "several devices draw into the host's memory: draw into a device's with that device alone");
  }
  if (pictures.on_device && scene.is_streamed()) {
    return make_error(Errc::bad_argument, Error::kNone, "streamed scenes are drawn into the host's memory");
  }
  for (const Camera& camera : cameras) {
    if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
    if (camera.width != cameras.front().width || camera.height != cameras.front().height)
      return make_error(Errc::bad_argument, Error::kNone, "the cameras of one call have different image sizes");
  }
  return detail::guard_memory([&] {
    return impl_->cuda && !scene.is_streamed() && (pictures.on_device || cameras.size() > 1)
               ? impl_->render_on_device(scene, cameras, pictures, options)
               : render_each(scene, cameras, pictures, options);
  });
}

Result<std::vector<FrameStats>> Renderer::Impl::render_on_device(const Scene& scene, std::span<const Camera> cameras,
                                                                 const PictureArrays& pictures,
                                                                 const RenderOptions& options) {
  const auto detail = drawn_detail(options, scene);
  if (!detail) return tl::unexpected(detail.error());
  const RenderOptions drawn = detail::with_levels(within_time(options), *detail);
  const auto settings = detail::resolve(drawn, scene.declarations(), Backend::cuda);
  if (!settings) return tl::unexpected(settings.error());
  const RenderOptions how = with_declarations(drawn, scene.declarations());
  const std::uint64_t n_pixels = cameras.empty() ? 0 : detail::pixels_of(cameras.front());
  const std::size_t n_parts = std::clamp<std::size_t>(cameras.size(), 1, 1 + others.size());
  auto parts = on_devices(n_parts, [&](detail::CudaBackend& device, std::size_t k) {
    const std::size_t first = cameras.size() * k / n_parts, end = cameras.size() * (k + 1) / n_parts;
    return device.render_all(scene, cameras.subspan(first, end - first),
                             detail::pictures_from(pictures, first, n_pixels), how);
  });
  std::vector<FrameStats> stats;
  stats.reserve(cameras.size());
  for (const auto& part : parts) {
    if (!part) return part;
    stats.insert(stats.end(), part->begin(), part->end());
  }
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    FrameStats& s = stats[i];
    s.depth_resolution = detail::depth_resolution(*settings, s.depth_bits, cameras[i], scene.declarations());
    s.stream.pages_missing = n_missing(scene, cameras[i], drawn, s.detail_px);
  }
  return stats;
}

Result<std::vector<FrameStats>> Renderer::render_each(const Scene& scene, std::span<const Camera> cameras,
                                                      const PictureArrays& pictures, const RenderOptions& options) {
  std::vector<FrameStats> all;
  std::vector<float>& scratch = impl_->scratch;
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const auto n = static_cast<std::size_t>(cameras[i].width) * static_cast<std::size_t>(cameras[i].height);
    RenderTarget target;
    if (pictures.rgb != nullptr) {
      target.rgb = {pictures.rgb + 3 * n * i, 3 * n};
    } else if (pictures.codes != nullptr) {
      scratch.resize(3 * n);
      target.rgb = scratch;
    }
    if (pictures.alpha != nullptr) target.alpha = {pictures.alpha + n * i, n};
    if (pictures.depth != nullptr) target.depth = {pictures.depth + n * i, n};
    const auto stats = render(scene, cameras[i], target, options);
    if (!stats) return tl::unexpected(stats.error());
    if (pictures.codes != nullptr) std::ranges::transform(target.rgb, pictures.codes + 3 * n * i, to_8bit);
    all.push_back(*stats);
  }
  return all;
}

Result<DeviceBlock> Renderer::allocate_on_device(std::uint64_t bytes) const {
  if (!impl_->cuda) {
    return make_error(Errc::unavailable, Error::kNone,
                      "only CUDA draws pictures into device memory: use Backend::cuda");
  }
  if (bytes == 0) return make_error(Errc::bad_argument, Error::kNone, "an array on the device has 0 bytes");
  return detail::guard_memory([&] { return impl_->cuda->allocate(bytes); });
}

Result<FrameStats> Renderer::Impl::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                          const RenderOptions& options) {
  const Backend backend = cuda ? Backend::cuda : Backend::cpu;
  const auto settings = detail::resolve(options, scene.declarations(), backend);
  if (!settings) return tl::unexpected(settings.error());
  if (const auto ok = detail::validate(target, camera); !ok) return tl::unexpected(ok.error());
  if (!target.contributions.empty()) {
    if (cuda) return make_error(Errc::bad_argument, Error::kNone, "only the CPU renderer counts contributions");
    if (target.contributions.size() != scene.size())
      return make_error(Errc::bad_argument, Error::kNone, "the contributions' size differs from the scene's",
                        scene.size(), target.contributions.size());
  }
  auto stats = cuda ? cuda->render(scene, camera, target, with_declarations(options, scene.declarations()))
                    : draw_on_cpu(scene, camera, target, options, *settings);
  // Here for CUDA too, where FP32 arrays carry no declarations.
  if (stats) {
    stats->depth_resolution = detail::depth_resolution(*settings, stats->depth_bits, camera, scene.declarations());
  }
  return stats;
}

Result<FrameStats> Renderer::Impl::draw_on_cpu(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                               const RenderOptions& options, const detail::FrameSettings& settings) {
  const float detail_px = detail::chosen_detail(scene, camera, options);
  const bool is_cut = detail_px > 0;
  const auto gaussians = is_cut ? scene.all_pages() : scene.view();
  if (!gaussians) return tl::unexpected(gaussians.error());
  std::vector<detail::ScenePart> parts;
  std::uint64_t n = 0;
  const auto add = [&](std::uint64_t first, std::uint64_t count) {
    parts.push_back(detail::part_of(*gaussians, first, count));
    n += count;
  };
  if (is_cut) {
    const auto cut = drawn_pages(scene, camera, detail_px);
    if (!cut) return tl::unexpected(cut.error());
    parts.reserve(cut->size());
    for (const std::uint32_t page : *cut) add(scene.levels()->pages()[page].first, scene.levels()->pages()[page].count);
  } else {
    add(0, gaussians->n);
  }
  if (n >= kMaxDrawn) return too_many(n);
  auto stats = reference->render({scene.sh_degree(), scene.origin(), parts}, camera, target, settings);
  if (stats && is_cut) stats->pages = parts.size(), stats->detail_px = detail_px;
  return stats;
}

// Pages that the view wants at this detail and the file's missing end would hold: as a streamed scene counts them.
std::uint64_t Renderer::Impl::n_missing(const Scene& scene, const Camera& camera, const RenderOptions& options,
                                        float detail_px) const {
  const PagedFile* const file = scene.levels();
  if (file == nullptr || file->n_present() == file->n_pages()) return 0;
  const auto settings = detail::resolve(options, scene.declarations(), cuda ? Backend::cuda : Backend::cpu);
  if (!settings) return 0;  // drawing refuses them
  const auto look = detail::StreamRule{*settings, scene.origin(), scene.declarations()->z_near, detail_px}.look(camera);
  const pages::ViewVolume volume(look.view, look.low_pass);
  const auto wanted = lod::drawn_pages(file->pages(), look.eye, look.detail_px);
  return static_cast<std::uint64_t>(std::ranges::count_if(wanted, [&](std::uint32_t page) {
    return page >= file->n_present() && volume.may_show(file->pages()[page].bounds);
  }));
}

// Draws a streamed scene like one with levels that is entirely in memory.
Result<detail::StreamRule> Renderer::Impl::rule_of(const Scene& scene, const Camera& camera,
                                                   const RenderOptions& options) const {
  const bool is_on_device = scene.streamed()->store->is_on_device();
  if (cuda && !is_on_device) {
    return make_error(
        Errc::unavailable, Error::kNone,
        "CUDA draws streamed scenes only if their pool has device memory: set StreamPoolOptions::device_memory, "
        "or use Backend::cpu");
  }
  if (!cuda && is_on_device) {
    return make_error(Errc::unavailable, Error::kNone,
                      "the scene's pages are in device memory, which the CPU does not draw: use Backend::cuda, or a "
                      "pool without device_memory");
  }
  if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
  const auto detail = detail::drawn_detail(options, true);
  if (!detail) return tl::unexpected(detail.error());
  const auto settings =
      detail::resolve(detail::with_levels(options, *detail), scene.declarations(), cuda ? Backend::cuda : Backend::cpu);
  if (!settings) return tl::unexpected(settings.error());
  return detail::StreamRule{*settings, scene.origin(), scene.declarations()->z_near, *detail,
                            options.max_gaussians.value_or(pages::kNoLimit)};
}

Result<FrameStats> Renderer::Impl::render(const detail::StreamFrame& frame, const Scene& scene, const Camera& camera,
                                          const RenderTarget& target, const RenderOptions& options) {
  return cuda->render({.slots = *frame.slots(),
                       .chunks = frame.chunks(),
                       .gaussians = frame.cut().gaussians,
                       .pages = static_cast<std::uint32_t>(frame.n_pages()),
                       .declarations = *scene.declarations()},
                      camera, target, options);
}

Result<FrameStats> Renderer::render_streamed(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                             const RenderOptions& options) {
  const auto rule = impl_->rule_of(scene, camera, options);
  if (!rule) return tl::unexpected(rule.error());
  if (const auto ok = detail::validate(target, camera); !ok) return tl::unexpected(ok.error());
  if (!target.contributions.empty()) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "contributions are not counted for streamed scenes: open the file without a pool");
  }
  return detail::guard_memory([&]() -> Result<FrameStats> {
    for (;;) {
      auto frame = detail::StreamFrame::begin(scene.streamed(), impl_->identity, camera, *rule);
      if (!frame) return tl::unexpected(frame.error());
      if (frame->cut().gaussians >= kMaxDrawn) {
        return too_many(frame->cut().gaussians);
      }
      auto stats = impl_->cuda ? impl_->render(*frame, scene, camera, target, options)
                               : impl_->reference->render({scene.sh_degree(), scene.origin(), frame->parts()}, camera,
                                                          target, rule->settings);
      if (stats && impl_->cuda) frame->drawn(stats->bytes);
      if (!stats && stats.error().code == Errc::device_out_of_memory) {
        frame->did_not_fit();
        if (frame->n_pages() > 1) continue;  // coarser
        return make_error(Errc::device_out_of_memory, Error::kNone,
                          "the device memory of the scene's pool has no room for a frame of this size: raise it, or "
                          "use fewer renderers",
                          stats.error().expected);
      }
      if (!stats) return stats;
      stats->pages = frame->n_pages();
      stats->detail_px = frame->cut().detail_px;
      impl_->n_cut = frame->cut().allowed_gaussians;
      stats->stream = frame->stats();
      stats->depth_resolution =
          detail::depth_resolution(rule->settings, stats->depth_bits, camera, scene.declarations());
      return stats;
    }
  });
}

Result<bool> Renderer::refine(const Scene& scene, const Camera& camera, double seconds, const RenderOptions& options) {
  if (!scene.is_streamed()) return true;
  const auto rule = impl_->rule_of(scene, camera, impl_->within_time(options));
  if (!rule) return tl::unexpected(rule.error());
  return detail::guard_memory(
      [&] { return detail::refine_view(*scene.streamed(), impl_->identity, camera, *rule, seconds); });
}

Backend Renderer::backend() const {
  return impl_->cuda ? Backend::cuda : Backend::cpu;
}
const char* Renderer::backend_name() const {
  return impl_->name.c_str();
}

}  // namespace rgs
