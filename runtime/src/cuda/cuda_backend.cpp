// cuda_backend.cpp - frames in host memory, drawn by the CUDA renderer.
// SPDX-License-Identifier: Apache-2.0
#include "cuda/cuda_backend.hpp"

#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <utility>

#include "cuda/device_memory.hpp"
#include "cuda/device_scene.hpp"
#include "cuda/file_upload.hpp"
#include "cuda/picture_batch.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::detail {
namespace {

// Uploads a kept file's attributes as stored, a third of the FP32 size. What the host has decoded is not decoded again.
Result<DeviceScene> upload(const Scene& scene) {
  if (scene.levels() != nullptr) return DeviceScene::upload(*scene.levels());
  if (scene.is_decoded()) {
    const auto data = scene.direct();
    if (!data) return tl::unexpected(data.error());
    return DeviceScene::upload(*data);
  }
  if (scene.has_file()) return DeviceScene::upload(*scene.file(), {.validate = !scene.is_validated()});
  const auto view = scene.view();
  if (!view) return tl::unexpected(view.error());
  return DeviceScene::upload(*view);
}

}  // namespace

/// A renderer and its pictures on the device.
struct FrameMaker {
  /// Errors: those of CudaRenderer::create().
  static Result<std::unique_ptr<FrameMaker>> create(const DeviceAllocator& allocator);
  Result<FrameStats> draw(const DeviceScene& of, const Camera& camera, const RenderTarget& target,
                          const RenderOptions& options);

  CudaRenderer renderer;
  std::shared_ptr<const DeviceMemory> memory;
  DeviceBuffer rgb = {}, alpha = {}, depth = {}, evaluated = {}, blended = {};
  OwnedStream to_host = {};
};

Result<std::unique_ptr<FrameMaker>> FrameMaker::create(const DeviceAllocator& allocator) {
  auto renderer = CudaRenderer::create(
      {.allocator = allocator, .frames_in_flight = PictureBatch::kFramesInFlight, .overlapping = false});
  if (!renderer) return tl::unexpected(renderer.error());
  auto memory = DeviceMemory::create(allocator);
  if (!memory) return tl::unexpected(memory.error());
  std::unique_ptr<FrameMaker> made(new FrameMaker{std::move(*renderer), std::move(*memory)});
  if (Status ok = made->to_host.create(); !ok) return tl::unexpected(ok.error());
  return made;
}

/// The content of a FrameWorkspace.
struct StreamedFrames {
  FrameWorkspace& workspace;
  std::shared_ptr<const DeviceMemory> memory;
  std::unique_ptr<FrameMaker> maker = {};

  /// Memory of the workspace.
  DeviceAllocator allocator() {
    return {[](void* user, std::uint64_t bytes, CudaStream stream) -> void* {
              const auto& self = *static_cast<const StreamedFrames*>(user);
              if (!self.workspace.fits(bytes)) return nullptr;
              const auto made = self.memory->allocate(bytes, stream);
              if (!made) return nullptr;
              self.workspace.take(bytes);
              return *made;
            },
            [](void* user, void* block, std::uint64_t bytes) {
              const auto& self = *static_cast<const StreamedFrames*>(user);
              self.memory->free(block, bytes);
              self.workspace.release(bytes);
            },
            this};
  }
};

struct CudaBackend::Impl {
  // f(), a Result or Status, with the device current.
  template <class F>
  auto on_device(const F& f) const -> decltype(f()) {
    const OnDevice here(device);
    return here.status() ? f() : tl::unexpected(here.status().error());
  }

  int device;
  std::unique_ptr<FrameMaker> maker;
  DeviceScene scene = {};
  std::uint64_t scene_identity = 0;
  PictureBatch batch{maker->renderer, maker->memory};
};

CudaBackend::CudaBackend(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
CudaBackend::CudaBackend(CudaBackend&&) noexcept = default;
CudaBackend::~CudaBackend() {
  if (impl_ == nullptr) return;
  const OnDevice here(impl_->device);
  impl_.reset();
}

Result<CudaBackend> CudaBackend::create(std::optional<int> device) {
  int current = 0, n_devices = 0;
  const bool answers =
      cudaGetDeviceCount(&n_devices) == cudaSuccess && n_devices > 0 && cudaGetDevice(&current) == cudaSuccess;
  if (answers && device.value_or(0) >= n_devices) {
    return make_error(Errc::bad_argument, Error::kNone,
                      "no CUDA device has this number: name devices that nvidia-smi lists and CUDA_VISIBLE_DEVICES "
                      "leaves, counted from 0",
                      static_cast<std::uint64_t>(n_devices - 1), static_cast<std::uint64_t>(*device));
  }
  const OnDevice here(device.value_or(current));
  if (answers && !here.status()) return tl::unexpected(here.status().error());
  auto maker = FrameMaker::create({});  // says why no device answers
  if (!maker) return tl::unexpected(maker.error());
  return CudaBackend(std::unique_ptr<Impl>(new Impl{device.value_or(current), std::move(*maker)}));
}

const char* CudaBackend::name() const {
  return impl_->maker->renderer.name();
}

Status CudaBackend::prepare(const Scene& scene) {
  if (impl_->scene_identity == scene.identity()) return {};
  return impl_->on_device([&]() -> Status {
    impl_->scene = {};  // before the next one: both may not fit
    impl_->scene_identity = 0;
    auto uploaded = upload(scene);
    if (!uploaded) return tl::unexpected(uploaded.error());
    impl_->scene = std::move(*uploaded);
    impl_->scene_identity = scene.identity();
    return {};
  });
}

Result<FrameStats> CudaBackend::render(const Scene& scene, const Camera& camera, const RenderTarget& target,
                                       const RenderOptions& options) {
  if (const auto ok = prepare(scene); !ok) return tl::unexpected(ok.error());
  return impl_->on_device([&] { return impl_->maker->draw(impl_->scene, camera, target, options); });
}

Result<std::vector<FrameStats>> CudaBackend::render_all(const Scene& scene, std::span<const Camera> cameras,
                                                        const PictureArrays& pictures, const RenderOptions& options) {
  if (const auto ok = prepare(scene); !ok) return tl::unexpected(ok.error());
  return impl_->on_device([&] { return impl_->batch.render(impl_->scene, cameras, pictures, options); });
}

// Not from the pool: whoever frees it may have queued work that reads it, and cudaFree() waits for that.
Result<DeviceBlock> CudaBackend::allocate(std::uint64_t bytes) const {
  const OnDevice here(impl_->device);
  if (!here.status()) return tl::unexpected(here.status().error());
  void* data = nullptr;
  DeviceBlock block{.data = nullptr, .device = impl_->device};
  const cudaError_t error = cudaMalloc(&data, bytes);
  if (error == cudaErrorMemoryAllocation) {
    cudaGetLastError();
    return make_error(Errc::device_out_of_memory, Error::kNone, "the device has no memory for pictures", bytes);
  }
  if (Status ok = device_status(error, "device memory could not be allocated"); !ok) return tl::unexpected(ok.error());
  block.data = {data, [](void* memory) { cudaFree(memory); }};
  return block;
}

// The destructor of the temporary storage waits for the frame, so the slots may be reused on return.
Result<FrameStats> CudaBackend::render(const SlotDraw& draw, const Camera& camera, const RenderTarget& target,
                                       const RenderOptions& options) {
  const OnDevice here(draw.slots.device());
  if (!here.status()) return tl::unexpected(here.status().error());
  const SlotPlan& plan = draw.slots.plan();
  auto storage = std::make_shared<SceneStorage>();
  storage->n = draw.gaussians;
  storage->sh_degree = plan.shape.sh_degree;
  storage->declarations = draw.declarations;
  storage->origin = draw.declarations.origin;
  SectionPlaces places{};
  for (std::size_t k = 0; k < places.size(); ++k) places[k] = draw.slots.at(k, 0);
  Header header;
  header.chunk_size = plan.shape.chunk_size;
  header.sh_degree = static_cast<std::uint8_t>(plan.shape.sh_degree);
  storage->attributes = cuda::PagedAttributes{compact_attributes(header, places)};
  ScenePages& pages = storage->pages.emplace();
  pages.chunk_size = plan.shape.chunk_size;
  pages.n_chunks = std::uint64_t{plan.n_slots} * plan.shape.page_chunks;
  pages.chosen = {draw.chunks, {draw.gaussians, draw.pages, static_cast<std::uint32_t>(draw.chunks.size()), 0, 0}};
  FrameWorkspace& workspace = draw.slots.workspace();
  const std::scoped_lock lock(workspace.drawing);
  if (workspace.content == nullptr) {
    auto memory = DeviceMemory::create({});
    if (!memory) return tl::unexpected(memory.error());
    const auto made = std::make_shared<StreamedFrames>(StreamedFrames{workspace, *std::move(memory)});
    auto maker = FrameMaker::create(made->allocator());
    if (!maker) return tl::unexpected(maker.error());
    made->maker = *std::move(maker);
    workspace.content = made;
  }
  FrameMaker& maker = *static_cast<StreamedFrames*>(workspace.content.get())->maker;
  auto stats = maker.draw(DeviceScene(std::move(storage)), camera, target, options);
  // Buffers of the size of a larger frame would leave no room for the others of a smaller one.
  if (!stats && stats.error().code == Errc::device_out_of_memory) workspace.content.reset();
  return stats;
}

Result<FrameStats> FrameMaker::draw(const DeviceScene& of, const Camera& camera, const RenderTarget& target,
                                    const RenderOptions& options) {
  DeviceTarget device;
  Status ok;
  const auto wanted = [this, &ok](DeviceBuffer& buffer, const auto& span, auto*& pointer) {
    if (span.empty() || !ok) return;
    ok = buffer.reserve(span.size_bytes(), memory, nullptr);
    pointer = buffer.as<std::remove_pointer_t<std::remove_reference_t<decltype(pointer)>>>();
  };
  wanted(rgb, target.rgb, device.rgb);
  wanted(alpha, target.alpha, device.alpha);
  wanted(depth, target.depth, device.depth);
  wanted(evaluated, target.evaluated, device.evaluated);
  wanted(blended, target.blended, device.blended);
  if (!ok) return tl::unexpected(ok.error());

  RenderOptions timed = options;
  timed.measure.timings = true;  // the picture is waited for anyway
  timed.turbo.asynchronous = false;
  auto stats = renderer.render(of, camera, device, timed);
  if (!stats) return stats;
  const auto fetch = [this, &ok](const auto& span, const void* pointer) {
    if (span.empty() || !ok) return;
    ok = copy_to_host(span.data(), pointer, span.size_bytes(), to_host, "a frame could not be copied from the device");
  };
  fetch(target.rgb, device.rgb);
  fetch(target.alpha, device.alpha);
  fetch(target.depth, device.depth);
  fetch(target.evaluated, device.evaluated);
  fetch(target.blended, device.blended);
  if (!ok) return tl::unexpected(ok.error());
  return stats;
}

}  // namespace rgs::detail
