// cuda_renderer.cpp - what a frame needs, the pipeline that draws it, and what it cost.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/cuda_renderer.hpp"

#include <algorithm>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "common/device_code.hpp"
#include "cuda/device_target.hpp"
#include "cuda/frame_state.hpp"
#include "cuda/frames_in_flight.hpp"
#include "cuda/sorted_pipeline.hpp"
#include "cuda/turbo_pipeline.hpp"
#include "render_options.hpp"
#include "rgs/guard_memory.hpp"
#include "turbo/turbo_geometry.hpp"

namespace rgs {
namespace {

using detail::device_status;
using detail::Frame;
using detail::FrameSettings;

// The largest valid image must fit every device's grid (65,535 blocks in y and z, 2^31 - 1 in x) and the bits that hold
// tiles (TurboBox 16, turbo_emit.cu 15).
constexpr std::uint64_t kMaxRows = kMaxImageSide / math::kTileSize, kMaxTurboRows = kMaxImageSide / cuda::kTurboTile;
static_assert(kMaxRows <= 65535 && kMaxTurboRows * kMaxTurboRows * cuda::kTurboCells < std::uint64_t{1} << 31);
static_assert(kMaxTurboRows <= std::uint64_t{1} << 15);

constexpr std::uint32_t kMaxFramesInFlight = 16;

cuda::CutEye cut_eye(const lod::Eye& eye, float detail_px, std::uint64_t max_gaussians) {
  const auto& at = eye.position;
  return {{at[0], at[1], at[2]}, eye.focal_px, eye.z_near, detail_px, max_gaussians};
}

cuda::ViewParameters view_of(const Camera& camera, const Origin& origin, const FrameSettings& settings, int sh_degree,
                             bool is_turbo) {
  cuda::ViewParameters view{};
  view.view = detail::make_view(camera, origin, settings);
  view.low_pass = settings.low_pass;
  view.anti_aliasing = settings.anti_aliasing;
  view.sh_degree = std::min(sh_degree, settings.sh_degree_limit);
  if (is_turbo) {
    view.grid = math::tile_grid<cuda::kTurboTile>(camera.width, camera.height);
    return view;
  }
  view.grid = math::tile_grid(camera.width, camera.height);
  const auto n_tiles = static_cast<std::uint32_t>(view.grid.columns * view.grid.rows);
  view.key = math::key_layout(settings.depth_order, settings.depth_bits, n_tiles);
  if (view.key.quantized) {
    view.quantizer = math::make_depth_quantizer(settings.depth_mapping, view.key.depth_bits, settings.depth_range[0],
                                                settings.depth_range[1]);
  }
  return view;
}

Status check_pairs(std::uint64_t pairs) {
  if (pairs <= detail::kMaxPairs) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "too many (tile, Gaussian) pairs in one frame",
                    detail::kMaxPairs, pairs);
}

}  // namespace

struct CudaRenderer::Impl {
  explicit Impl(const CudaRendererOptions& options)
      : can_overlap(options.overlapping), readbacks(options.frames_in_flight), in_flight(options.frames_in_flight) {}
  ~Impl() { wait_for_all(); }  // it uses all of this until then

  // What draws a frame at a time.
  struct Workspace {
    Status create() {
      const Status ok = state.own.create();
      return ok ? turbo.create() : ok;
    }
    std::uint64_t bytes() const { return state.splats.bytes() + state.cut.bytes() + sorted.bytes() + turbo.bytes(); }

    detail::FrameState state;
    detail::SortedPipeline sorted{state};
    detail::TurboPipeline turbo{state};
  };

  struct Outcome {
    FrameStats stats;
    bool is_repeated;
  };

  // Calls `use` with the pipeline that draws the frame; once more without the second workspace if memory runs out.
  template <class Use>
  auto with_pipeline(const Frame& f, const Use& use) {
    const auto once = [&] {
      Workspace& w = *workspaces[std::min(f.turn.value_or(0), workspaces.size() - 1)];
      return f.is_turbo ? use(w.turbo) : use(w.sorted);
    };
    auto used = once();
    if (used || used.error().code != Errc::device_out_of_memory || workspaces.size() == 1) return used;
    wait_for_all();
    workspaces.pop_back();
    can_overlap = false;
    return once();
  }
  Status create(const DeviceAllocator& allocator);
  Status add_workspace();
  bool overlaps();
  Status queue(const Frame& frame) {
    return with_pipeline(frame, [&](auto& pipeline) { return pipeline.queue(frame); });
  }
  Result<Outcome> outcome(const Frame& frame);
  Status settle_oldest();
  void wait_for_all() const {
    for (const auto& w : workspaces) w->state.wait_for_all();
  }
  std::uint64_t bytes() const {
    std::uint64_t sum = 0;
    for (const auto& w : workspaces) sum += w->bytes();
    return sum;
  }

  std::string name;
  std::shared_ptr<const detail::DeviceMemory> memory;
  detail::FrameOrder order;
  std::vector<std::unique_ptr<Workspace>> workspaces;  // one, or two that overlapping frames use in turn
  std::size_t turn = 0;                                // of the last frame
  bool can_overlap;                                    // a second workspace may be added
  std::vector<detail::Readback> readbacks;             // by FramesInFlight::next_number()
  detail::FramesInFlight<Frame> in_flight;
  FrameStats last;  // of the frame that was settled last
};

namespace {

// Why no device can be used, given cudaGetDeviceCount()'s error. Any driver of the toolkit's major version or a later
// one works: CUDA Compatibility, "Minor Version Compatibility", whose table has the releases.
tl::unexpected<Error> no_device(cudaError_t counted) {
  static_assert(CUDART_VERSION >= 12000, "driver releases below are those of CUDA 12 and later");
  constexpr bool kCuda12 = CUDART_VERSION < 13000;
  cudaGetLastError();
  int driver = 0;  // stays 0 without a driver
  if (counted != cudaErrorInsufficientDriver || cudaDriverGetVersion(&driver) != cudaSuccess)
    return make_error(Errc::unavailable, Error::kNone, "no CUDA device answers; use the CPU backend");
  if (driver == 0) {
    return make_error(Errc::unavailable, Error::kNone,
                      kCuda12 ? "no NVIDIA driver is found; install driver 525 or later, or use the CPU backend"
                              : "no NVIDIA driver is found; install driver 580 or later, or use the CPU backend");
  }
  return make_error(
      Errc::unavailable, Error::kNone,
      kCuda12 ? "the NVIDIA driver's CUDA version is too old; install driver 525 or later, or use the CPU backend"
              : "the NVIDIA driver's CUDA version is too old; install driver 580 or later, or use the CPU backend",
      CUDART_VERSION / 1000, static_cast<std::uint64_t>(driver / 1000));
}

}  // namespace

CudaRenderer::CudaRenderer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
CudaRenderer::CudaRenderer(CudaRenderer&&) noexcept = default;
CudaRenderer& CudaRenderer::operator=(CudaRenderer&&) noexcept = default;
CudaRenderer::~CudaRenderer() = default;

Result<CudaRenderer> CudaRenderer::create(const CudaRendererOptions& options) {
  if (options.frames_in_flight < 1 || options.frames_in_flight > kMaxFramesInFlight) {
    return make_error(Errc::bad_argument, Error::kNone, "a renderer has 1 to 16 frames in flight", kMaxFramesInFlight,
                      options.frames_in_flight);
  }
  return detail::guard_memory([&]() -> Result<CudaRenderer> {
    int device = 0, n_devices = 0;
    const cudaError_t counted = cudaGetDeviceCount(&n_devices);
    if (counted != cudaSuccess || n_devices == 0 || cudaGetDevice(&device) != cudaSuccess) return no_device(counted);
    cudaDeviceProp properties{};
    if (const auto ok =
            device_status(cudaGetDeviceProperties(&properties, device), "the device's properties could not be read");
        !ok) {
      return tl::unexpected(ok.error());
    }
    if (const auto ok = cuda::check_device_code(); !ok) return tl::unexpected(ok.error());
    auto impl = std::make_unique<Impl>(options);
    impl->name = std::string("cuda ") + properties.name;
    if (const auto ok = impl->create(options.allocator); !ok) return tl::unexpected(ok.error());
    return CudaRenderer(std::move(impl));
  });
}

Status CudaRenderer::Impl::create(const DeviceAllocator& allocator) {
  auto made = detail::DeviceMemory::create(allocator);
  if (!made) return tl::unexpected(made.error());
  memory = *std::move(made);
  order.finished = readbacks.front().finished;
  Status ok;
  for (detail::Readback& readback : readbacks) {
    if (ok) ok = readback.create();
  }
  return ok ? add_workspace() : ok;
}

Status CudaRenderer::Impl::add_workspace() {
  std::unique_ptr<Workspace> added(new Workspace{{order, memory, order.finished}});
  Status ok = added->create();
  if (ok) workspaces.push_back(std::move(added));
  return ok;
}

// Whether queued frames overlap. Adds the second workspace where there is room, once a frame follows a queued one.
bool CudaRenderer::Impl::overlaps() {
  if (can_overlap && workspaces.size() == 1 && !in_flight.is_empty()) {
    can_overlap = detail::room_for(workspaces.front()->bytes()) > 0 && add_workspace();
  }
  return workspaces.size() > 1;
}

std::uint64_t CudaRenderer::bytes() const {
  return impl_->bytes();
}
const char* CudaRenderer::name() const {
  return impl_->name.c_str();
}

// What the oldest frame cost once it is settled, including all that its settings measure.
Result<CudaRenderer::Impl::Outcome> CudaRenderer::Impl::outcome(const Frame& f) {
  const auto settled = with_pipeline(f, [&](auto& pipeline) { return pipeline.settle(f); });
  if (!settled) return tl::unexpected(settled.error());
  Status ok = check_pairs(settled->pairs);
  const auto& how = f.settings.cuda;
  if (ok && (how.timings || how.count_pairs)) ok = f.readback->finished->wait();
  if (!ok) return tl::unexpected(ok.error());
  const detail::Readback::Seen& seen = f.seen();
  FrameStats stats;
  stats.gaussians = f.cut ? seen.cut.gaussians : f.n();
  stats.detail_px = f.cut ? seen.cut.detail_px : 0;
  stats.pages = stats.detail_px > 0 ? seen.cut.pages : 0;
  stats.visible = seen.counters.visible;
  stats.instances = settled->pairs;
  stats.depth_bits = f.view.key.quantized ? f.view.key.depth_bits : 0;
  stats.key_bits = f.view.key.bits();
  stats.depth_resolution = f.depth_resolution;
  stats.bytes = bytes();
  if (how.count_pairs) {
    stats.evaluated = seen.counted.evaluated;
    stats.blended = seen.counted.blended;
  }
  if (how.timings) {
    using detail::Mark;
    const auto between = [&](Mark from, Mark to) {
      float ms = 0;
      if (ok) {
        ok = device_status(cudaEventElapsedTime(&ms, f.readback->marks[from].get(), f.readback->marks[to].get()),
                           "a stage's time could not be read");
      }
      return static_cast<double>(ms);
    };
    if (how.stage_timings) {
      stats.project_ms = between(detail::kStart, detail::kProjected);
      stats.sort_ms = between(detail::kDuplicated, detail::kSorted);
      stats.bin_ms = between(detail::kProjected, detail::kDuplicated) + between(detail::kSorted, detail::kRanged);
      stats.blend_ms = between(detail::kRanged, detail::kBlended);
    }
    stats.total_ms = between(detail::kStart, detail::kBlended);
    if (!ok) return tl::unexpected(ok.error());
  }
  return Outcome{stats, settled->is_repeated};
}

// After an error nothing is running: the caller may free scenes and targets of all frames.
Status CudaRenderer::Impl::settle_oldest() {
  const auto settled = in_flight.settle_oldest(
      [this](const Frame& f) {
        auto drawn = detail::guard_memory([&] { return outcome(f); });
        if (!drawn) wait_for_all();
        return drawn;
      },
      [this](const Frame& f) {
        const Status ok = detail::guard_memory([&] { return queue(f); });
        if (!ok) wait_for_all();
        return ok;
      });
  if (in_flight.is_empty()) order.ordered_by.reset();
  last = settled ? settled->stats : FrameStats{};
  return settled ? Status() : tl::unexpected(settled.error());
}

Result<FrameStats> CudaRenderer::render(const DeviceScene& scene, const Camera& camera, const DeviceTarget& target,
                                        const RenderOptions& options, CudaStream stream) {
  return detail::guard_memory([&]() -> Result<FrameStats> {
    Impl& w = *impl_;
    if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
    const auto detail_px = detail::drawn_detail(options, scene.has_levels());
    if (!detail_px) return tl::unexpected(detail_px.error());
    const auto resolved =
        detail::resolve(detail::with_levels(options, *detail_px), scene.declarations(), Backend::cuda);
    if (!resolved) return tl::unexpected(resolved.error());
    const FrameSettings& settings = *resolved;
    Status ok = detail::validate(target, camera);
    if (ok) ok = detail::validate_surface(target, camera);
    if (!ok) return tl::unexpected(ok.error());

    const bool is_turbo = settings.cuda.turbo, is_queued = settings.cuda.asynchronous;
    while (is_queued ? w.in_flight.is_full() : !w.in_flight.is_empty()) {
      if (ok = w.settle_oldest(); !ok) return tl::unexpected(ok.error());
    }
    Frame frame{.scene = scene.storage_,
                .width = camera.width,
                .height = camera.height,
                .target = detail::arrays_of(target, camera),
                .view = view_of(camera, scene.origin(), settings, scene.sh_degree(), is_turbo),
                .settings = settings,
                .stream = stream,
                .depth_resolution = 0,
                .is_turbo = is_turbo,
                .cut = std::nullopt,
                .readback = &w.readbacks[w.in_flight.next_number()]};
    if (scene.has_levels()) {
      frame.cut = cut_eye(detail::eye_of(camera, scene.origin(), scene.declarations()->z_near), *detail_px,
                          options.max_gaussians.value_or(cuda::kNoLimit));
    }
    if (!frame.cut) ok = detail::check_splats(frame.n_splats());
    if (!ok) return tl::unexpected(ok.error());
    if (frame.view.key.quantized) {
      frame.depth_resolution =
          detail::depth_resolution(settings, frame.view.key.depth_bits, camera, scene.declarations());
    }
    if (is_queued && !frame.cut && w.overlaps()) frame.turn = 1 - w.turn;
    w.turn = frame.turn.value_or(0);
    if (ok = w.queue(frame); !ok) {
      w.last = {};
      w.wait_for_all();  // the caller may free the scene
      return tl::unexpected(ok.error());
    }
    FrameStats queued;
    queued.gaussians = frame.cut ? 0 : frame.n();
    queued.bytes = w.bytes();
    w.in_flight.add(std::move(frame));
    if (is_queued) return queued;
    if (ok = w.settle_oldest(); !ok) return tl::unexpected(ok.error());
    return w.last;
  });
}

Result<FrameStats> CudaRenderer::finish_oldest() {
  return detail::guard_memory([&]() -> Result<FrameStats> {
    Impl& w = *impl_;
    const Status ok = w.in_flight.is_empty() ? w.order.finished->wait() : w.settle_oldest();
    if (!ok) return tl::unexpected(ok.error());
    return w.last;
  });
}

Result<FrameStats> CudaRenderer::finish() {
  Result<FrameStats> last = finish_oldest();
  while (last && !impl_->in_flight.is_empty()) last = finish_oldest();
  return last;
}

}  // namespace rgs
