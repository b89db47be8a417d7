// frame_maker.cpp - one renderer for all scenes; encodes one frame while the next is drawn.
// SPDX-License-Identifier: Apache-2.0
#include "frame_maker.hpp"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <chrono>
#include <mutex>
#include <utility>

#include "image_file.hpp"
#include "input_files.hpp"
#include "jpeg.hpp"
#include "rgs/version.hpp"
#include "scene_file.hpp"

namespace rgs::view {
namespace {

using Clock = std::chrono::steady_clock;
constexpr int kPngLevel = 1;  // speed matters, not size
constexpr std::size_t kCodesOfTask = 100'000;

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

// The memory of a frame, which later frames reuse.
struct Workspace {
  Image image;
  std::vector<std::uint8_t> codes;
  JpegEncoder jpeg;

  void resize(int width, int height) {
    image.width = width;
    image.height = height;
    image.channels = 3;
    image.pixels.resize(std::size_t{3} * static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  }

  Result<std::string> encode(const FrameRequest& request, tbb::task_arena& threads) {
    if (request.format == ImageFormat::jpeg) {
      codes.resize(image.pixels.size());
      threads.execute([&] {
        tbb::parallel_for(tbb::blocked_range<std::size_t>(0, codes.size(), kCodesOfTask), [&](const auto& range) {
          for (std::size_t i = range.begin(); i < range.end(); ++i) codes[i] = to_8bit(image.pixels[i]);
        });
      });
      return jpeg.encode(codes, image.width, image.height, request.quality);
    }
    return encode_image(image, request.format, {.png_level = kPngLevel, .software = "rgs-view " RGS_VERSION})
        .map([](const auto& bytes) { return std::string(reinterpret_cast<const char*>(bytes.data()), bytes.size()); });
  }
};

// Errors of a file without levels of detail.
bool is_not_streamable(const Error& error) {
  return error.code == Errc::missing_section || error.code == Errc::bad_magic;
}

}  // namespace

struct FrameMaker::Impl {
  Impl(Renderer made, int n_threads)
      : renderer(std::move(made)), threads(n_threads > 0 ? n_threads : tbb::task_arena::automatic) {}

  Workspace take_workspace() {
    const std::scoped_lock lock(spare_lock);
    if (spare.empty()) return {};
    Workspace workspace = std::move(spare.back());
    spare.pop_back();
    return workspace;
  }
  void release(Workspace workspace) {
    constexpr std::size_t kMost = 2;
    const std::scoped_lock lock(spare_lock);
    if (spare.size() < kMost) spare.push_back(std::move(workspace));
  }

  Renderer renderer;
  tbb::task_arena threads;
  std::optional<StreamPool> pool;
  std::vector<Scene> scenes;
  tool::InputFiles inputs;
  std::mutex drawing, spare_lock;
  std::vector<Workspace> spare;
};

FrameMaker::FrameMaker(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
FrameMaker::FrameMaker(FrameMaker&&) noexcept = default;
FrameMaker& FrameMaker::operator=(FrameMaker&&) noexcept = default;
FrameMaker::~FrameMaker() = default;

tl::expected<FrameMaker, SceneError> FrameMaker::create(const std::vector<std::string>& paths,
                                                        const FrameSettings& settings) {
  const auto fail = [](std::string path, const Error& error) {
    return tl::unexpected(SceneError{std::move(path), error});
  };
  auto renderer = Renderer::create({.backend = settings.backend, .threads = settings.threads});
  if (!renderer) return fail({}, renderer.error());
  auto impl = std::make_unique<Impl>(*std::move(renderer), settings.threads);
  if (settings.budget) {
    auto pool = StreamPool::create(*settings.budget);
    if (!pool) return fail({}, pool.error());
    impl->pool = *std::move(pool);
  }
  bool is_any_streamed = false;
  for (const std::string& path : paths) {
    impl->inputs.add_scene(path);
    // If the file has changed, that explains every other error.
    const auto fail_at = [&](const Error& error) {
      return fail(path, impl->inputs.changed() ? tool::kFileChanged : error);
    };
    if (impl->pool) {
      auto streamed = Scene::open(path, {.pool = impl->pool, .limits = settings.read.limits});
      if (streamed) {
        is_any_streamed = true;
        impl->scenes.emplace_back(*std::move(streamed));
        continue;
      }
      if (!is_not_streamable(streamed.error())) return fail_at(streamed.error());
    }
    auto opened = open_scene_file(path, settings.read);
    if (!opened) return fail_at(opened.error());
    // With levels of detail the CPU decodes only the pages that it draws.
    if (opened->scene.levels() == nullptr || impl->renderer.backend() == Backend::cuda) {
      if (const Status prepared = impl->renderer.prepare(opened->scene); !prepared) return fail_at(prepared.error());
    }
    impl->scenes.emplace_back(std::move(opened->scene));
  }
  if (impl->pool && !is_any_streamed) {
    return fail({},
                {Errc::bad_argument, Error::kNone,
                 "--host-memory and --device-memory need an .rgs file with levels of detail: rgs-convert --lod makes "
                 "one"});
  }
  return FrameMaker(std::move(impl));
}

Backend FrameMaker::backend() const {
  return impl_->renderer.backend();
}

std::size_t FrameMaker::n_scenes() const {
  return impl_->scenes.size();
}

Result<Frame> FrameMaker::make(const FrameRequest& request) {
  Workspace workspace = impl_->take_workspace();
  workspace.resize(request.camera.width, request.camera.height);
  Frame frame;
  {
    const std::scoped_lock lock(impl_->drawing);
    const auto start = Clock::now();
    const Scene& scene = impl_->scenes.at(request.scene);
    const auto drawn = impl_->renderer.render(scene, request.camera, {.rgb = workspace.image.pixels}, request.options);
    frame.render_ms = ms_since(start);
    if (impl_->inputs.changed()) return tl::unexpected(tool::kFileChanged);
    if (!drawn) return tl::unexpected(drawn.error());
    if (scene.is_streamed()) {
      frame.stream = drawn->stream;
      if (const Status status = scene.status(); !status) frame.stream_error = status.error();
    }
  }
  const auto start = Clock::now();
  auto file = workspace.encode(request, impl_->threads);
  if (!file) return tl::unexpected(file.error());
  frame.file = *std::move(file);
  frame.encode_ms = ms_since(start);
  impl_->release(std::move(workspace));
  return frame;
}

}  // namespace rgs::view
