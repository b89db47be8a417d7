// cuda_renderer.cpp - a frame's stages on a stream, their workspace, and the one number that comes back in between.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/cuda_renderer.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "cuda/device_buffer.hpp"
#include "cuda/device_scene.hpp"
#include "cuda/frame_graph.hpp"
#include "cuda/workspace_growth.hpp"
#include "render_options.hpp"
#include "sorted/blend.hpp"
#include "sorted/front_end.hpp"
#include "sorted/sort.hpp"
#include "turbo/turbo.hpp"

namespace rgs {
namespace {

using detail::device_status;
using detail::DeviceBuffer;

// CUB counts pairs with 31 bits.
constexpr std::uint64_t kMaxPairs = std::numeric_limits<std::int32_t>::max();
// Pairs that the workspace holds before a frame has shown how many there are.
constexpr std::uint64_t kFirstPairs = std::uint64_t{1} << 20;

// Ends of the stages, as FrameStats names them.
enum Mark { kStart, kProjected, kDuplicated, kSorted, kRanged, kBlended, kMarks };

math::Vec3<float> background_of(const RenderOptions& options) {
  return {options.background[0], options.background[1], options.background[2]};
}

cuda::PixelArrays arrays_of(const DeviceTarget& target) {
  return {target.rgb, target.alpha, target.depth, target.evaluated, target.blended, target.packed, target.format};
}

Status check(const DeviceTarget& target) {
  const auto refuse = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
  if (target.packed == nullptr) return {};
  if (target.format > math::PixelFormat::rgba16f) return refuse("a pixel format has no such value");
  if (reinterpret_cast<std::uintptr_t>(target.packed) % math::pixel_bytes(target.format) != 0) {
    return refuse("a packed target is not aligned to its pixels");
  }
  return {};
}

// Where Gaussians may be narrower, coefficients of their exponents may leave the range of FP16.
constexpr float kTensorLowPass = 0.1F;

tl::unexpected<Error> too_many(std::uint64_t pairs) {
  return make_error(Errc::limit_exceeded, Error::kNone, "too many (tile, Gaussian) pairs in one frame", kMaxPairs,
                    pairs);
}

bool draws_turbo(const RenderOptions& options, std::uint64_t n_gaussians) {
  return options.cuda.turbo && n_gaussians < cuda::kMaxTurboGaussians;
}

// Numbers that the host waits for, in memory that the device can write asynchronously.
struct HostCounters {
  cuda::Counters counters;
  std::uint64_t pairs;  // of the separate front end: the last of its sums
  cuda::TurboState turbo;
};

}  // namespace

struct CudaRenderer::Impl {
  ~Impl() {
    if (finished != nullptr) cudaEventSynchronize(finished);  // the device writes to `host` until then
    for (cudaEvent_t event : events) {
      if (event != nullptr) cudaEventDestroy(event);
    }
    for (cudaEvent_t event : {counted, finished, listed, ordered_long}) {
      if (event != nullptr) cudaEventDestroy(event);
    }
    if (beside != nullptr) cudaStreamDestroy(beside);
    cudaFreeHost(host);
  }

  // A frame of the turbo pipeline, and all that it takes to make it again.
  struct TurboFrame {
    DeviceScene scene;
    int width, height;  // px
    DeviceTarget target;
    cuda::ViewParameters view;
    RenderOptions options;
    CudaStream stream;
  };

  static const DeviceScene::Storage& stored(const DeviceScene& scene) {
    static const DeviceScene::Storage kEmpty;
    return scene.storage_ ? *scene.storage_ : kEmpty;
  }
  Status reserve_scene(std::uint64_t n, bool separate, bool deterministic);
  Status reserve_pairs(std::uint64_t needed, std::uint64_t generous, bool narrow);
  Status reserve_turbo(std::uint64_t n_entries, std::uint64_t n_runs, std::uint64_t n_large, std::uint64_t n_in_cells);
  cuda::PairArrays pair_arrays(bool narrow) const;
  Status mark(Mark m, const RenderOptions& options, CudaStream stream);
  Result<std::uint64_t> fused(const DeviceScene::Storage& scene, const cuda::ViewParameters& view,
                              const RenderOptions& options, bool narrow, CudaStream stream);
  Result<std::uint64_t> separate(const DeviceScene::Storage& scene, const cuda::ViewParameters& view,
                                 const RenderOptions& options, bool narrow, CudaStream stream);
  Status prepare_turbo(const TurboFrame& frame);
  std::uint64_t entry_capacity() const;
  std::uint64_t run_capacity() const;
  cuda::TurboLongListSizes long_sizes() const { return cuda::TurboLongListSizes::of(entry_capacity(), run_capacity()); }
  cuda::TurboArrays turbo_arrays(const TurboFrame& frame) const;
  Status order_turbo(const cuda::TurboArrays& arrays, math::TileGrid grid, CudaStream on);
  Status launch_turbo(const TurboFrame& frame, CudaStream on);
  Status queue_turbo(const TurboFrame& frame);
  Result<std::uint64_t> settle(const TurboFrame& frame);
  Result<std::uint64_t> sorted(const DeviceScene::Storage& scene, const Camera& camera, const DeviceTarget& target,
                               const cuda::ViewParameters& view, const RenderOptions& options, CudaStream stream);
  Status order(const cuda::ViewParameters& view, std::uint64_t pairs, bool narrow, const RenderOptions& options,
               CudaStream stream, cuda::SortBuffers& sorted);
  Status fetch(void* to, const void* from, std::uint64_t bytes, CudaStream stream) const;
  Status wait(CudaStream stream) const;
  Status begin(CudaStream stream) const;
  Status end(CudaStream stream) const;
  Result<FrameStats> outcome(std::uint64_t n_gaussians, std::uint64_t pairs, const cuda::ViewParameters& view,
                             const RenderOptions& options, CudaStream stream);
  std::uint64_t bytes() const;

  std::string name;
  std::array<cudaEvent_t, kMarks> events{};
  cudaEvent_t counted = nullptr;  // the turbo pipeline has counted its pairs
  cudaStream_t beside = nullptr;  // for long lists; `listed` begins what is queued there, `ordered_long` ends it
  cudaEvent_t listed = nullptr, ordered_long = nullptr;
  cudaEvent_t finished = nullptr;  // the last frame no longer uses the workspace
  HostCounters* host = nullptr;
  std::optional<TurboFrame> open;  // queued; whether it fitted has not been looked at
  FrameStats last;                 // of the last frame that was looked at
  detail::FrameGraph graph;
  DeviceBuffer counters, splats, covers, tiles, sums, sum_temporary, block_state;
  DeviceBuffer keys, spare_keys, gaussians, spare_gaussians, sort_temporary, ranges;
  DeviceBuffer turbo_state, turbo_entries, turbo_scratch, turbo_runs, tile_runs, turbo_large, lists, classes;
  DeviceBuffer long_lists, cells, cell_gaussians;
};

CudaRenderer::CudaRenderer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
CudaRenderer::CudaRenderer(CudaRenderer&&) noexcept = default;
CudaRenderer& CudaRenderer::operator=(CudaRenderer&&) noexcept = default;
CudaRenderer::~CudaRenderer() = default;

Result<CudaRenderer> CudaRenderer::create() {
  int device = 0, n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0 || cudaGetDevice(&device) != cudaSuccess) {
    cudaGetLastError();
    return make_error(Errc::unavailable, Error::kNone, "no CUDA device answers; use the CPU backend");
  }
  cudaDeviceProp properties{};
  if (const auto ok =
          device_status(cudaGetDeviceProperties(&properties, device), "the device does not describe itself");
      !ok) {
    return tl::unexpected(ok.error());
  }
  auto impl = std::make_unique<Impl>();
  impl->name = std::string("cuda ") + properties.name;
  Status ok = device_status(cudaMallocHost(reinterpret_cast<void**>(&impl->host), sizeof(HostCounters)),
                            "page-locked memory is not to be had");
  for (cudaEvent_t& event : impl->events) {
    if (ok) ok = device_status(cudaEventCreate(&event), "an event could not be made");
  }
  for (cudaEvent_t* event : {&impl->counted, &impl->finished, &impl->listed, &impl->ordered_long}) {
    if (ok) ok = device_status(cudaEventCreateWithFlags(event, cudaEventDisableTiming), "an event could not be made");
  }
  int least = 0, greatest = 0;
  if (ok) {
    ok = device_status(cudaDeviceGetStreamPriorityRange(&least, &greatest), "the device has no priorities");
  }
  if (ok) {  // of high priority: what it holds takes longest, and its blocks come when those of the others are queued
    ok = device_status(cudaStreamCreateWithPriority(&impl->beside, cudaStreamNonBlocking, greatest),
                       "a stream could not be made");
  }
  if (ok) ok = impl->counters.reserve(sizeof(cuda::Counters));
  if (!ok) return tl::unexpected(ok.error());
  return CudaRenderer(std::move(impl));
}

std::uint64_t CudaRenderer::bytes() const {
  return impl_->bytes();
}
const char* CudaRenderer::name() const {
  return impl_->name.c_str();
}

std::uint64_t CudaRenderer::Impl::bytes() const {
  std::uint64_t sum = 0;
  for (const DeviceBuffer* b :
       {&counters,      &splats,         &covers,     &tiles,           &sums,           &sum_temporary, &block_state,
        &keys,          &spare_keys,     &gaussians,  &spare_gaussians, &sort_temporary, &ranges,        &turbo_state,
        &turbo_entries, &turbo_scratch,  &turbo_runs, &tile_runs,       &turbo_large,    &lists,         &classes,
        &cells,         &cell_gaussians, &long_lists}) {
    sum += b->bytes();
  }
  return sum;
}

Status CudaRenderer::Impl::reserve_scene(std::uint64_t n, bool separate, bool deterministic) {
  Status ok = splats.reserve(n * sizeof(cuda::ScreenSplat));
  if (ok && deterministic && !separate) {
    ok = block_state.reserve((cuda::fused_blocks(static_cast<std::uint32_t>(n)) + 1) * sizeof(std::uint64_t));
  }
  if (!ok || !separate) return ok;
  const auto temporary = cuda::sum_bytes(static_cast<std::uint32_t>(n));
  if (!temporary) return tl::unexpected(temporary.error());
  ok = covers.reserve(n * cuda::cover_bytes());
  if (ok) ok = tiles.reserve(n * sizeof(std::uint32_t));
  if (ok) ok = sums.reserve(n * sizeof(std::uint64_t));
  if (ok) ok = sum_temporary.reserve(*temporary);
  return ok;
}

// Room for `generous` pairs and the sort of them, or for `needed` ones if that is too much.
Status CudaRenderer::Impl::reserve_pairs(std::uint64_t needed, std::uint64_t generous, bool narrow) {
  const std::uint64_t key_bytes = narrow ? 4 : 8;
  return detail::reserve_growing([&](bool is_generous) -> Status {
    const std::uint64_t wanted = is_generous ? generous : needed;
    // For keys of either width: those of the next frame may be the other.
    const auto temporary = cuda::sort_bytes(wanted, narrow), other = cuda::sort_bytes(wanted, !narrow);
    if (!temporary) return tl::unexpected(temporary.error());
    if (!other) return tl::unexpected(other.error());
    Status ok = sort_temporary.reserve(std::max(*temporary, *other));
    for (DeviceBuffer* b : {&keys, &spare_keys}) {
      if (ok) ok = b->reserve(wanted * key_bytes);
    }
    for (DeviceBuffer* b : {&gaussians, &spare_gaussians}) {
      if (ok) ok = b->reserve(wanted * sizeof(std::uint32_t));
    }
    if (ok) return {};
    // All or nothing: of the arrays that have grown and those that have not, the next frame would see the latter alone.
    for (DeviceBuffer* b : {&keys, &spare_keys, &gaussians, &spare_gaussians, &sort_temporary}) *b = {};
    return ok;
  });
}

cuda::PairArrays CudaRenderer::Impl::pair_arrays(bool narrow) const {
  const std::uint64_t capacity = std::min({gaussians.bytes() / 4, keys.bytes() / (narrow ? 4 : 8), kMaxPairs});
  return {keys.as<void>(), gaussians.as<std::uint32_t>(), capacity, narrow};
}

Status CudaRenderer::Impl::mark(Mark m, const RenderOptions& options, CudaStream stream) {
  const bool is_stage = m != kStart && m != kBlended;
  if (!options.cuda.timings || (is_stage && !options.cuda.stage_timings)) return {};
  return device_status(cudaEventRecord(events[m], stream), "an event could not be recorded");
}

Status CudaRenderer::Impl::fetch(void* to, const void* from, std::uint64_t size, CudaStream stream) const {
  return device_status(cudaMemcpyAsync(to, from, size, cudaMemcpyDeviceToHost, stream),
                       "counters could not be copied from the device");
}
Status CudaRenderer::Impl::wait(CudaStream stream) const {
  return device_status(cudaStreamSynchronize(stream), "a kernel failed");
}

// The last frame may be on another stream, and still at work.
Status CudaRenderer::Impl::begin(CudaStream stream) const {
  return device_status(cudaStreamWaitEvent(stream, finished), "the last frame cannot be waited for");
}
Status CudaRenderer::Impl::end(CudaStream stream) const {
  return device_status(cudaEventRecord(finished, stream), "an event could not be recorded");
}

// Pairs of the frame. They are all in the arrays on return; if they did not fit, the kernel has run a second time.
Result<std::uint64_t> CudaRenderer::Impl::fused(const DeviceScene::Storage& scene, const cuda::ViewParameters& view,
                                                const RenderOptions& options, bool narrow, CudaStream stream) {
  for (;;) {
    Status ok = device_status(cudaMemsetAsync(counters.as<void>(), 0, sizeof(cuda::Counters), stream),
                              "counters could not be cleared");
    if (ok && options.cuda.deterministic) {
      ok = device_status(cudaMemsetAsync(block_state.as<void>(), 0, block_state.bytes(), stream),
                         "the scan's state could not be cleared");
    }
    const cuda::PairArrays pairs = pair_arrays(narrow);
    if (ok) {
      ok = cuda::launch_fused({scene.attributes, static_cast<std::uint32_t>(scene.n), view, options.extent,
                               splats.as<cuda::ScreenSplat>(), pairs, counters.as<cuda::Counters>(),
                               options.cuda.deterministic ? block_state.as<std::uint64_t>() : nullptr},
                              stream);
    }
    if (ok) ok = mark(kProjected, options, stream);
    if (ok) ok = fetch(&host->counters, counters.as<void>(), sizeof(cuda::Counters), stream);
    if (ok) ok = wait(stream);
    if (!ok) return tl::unexpected(ok.error());
    const std::uint64_t n = host->counters.instances;
    if (n > kMaxPairs || n <= pairs.capacity) return n;
    if (ok = reserve_pairs(n, detail::with_room_to_grow(n, pairs.capacity, kMaxPairs), narrow); !ok) {
      return tl::unexpected(ok.error());
    }
  }
}

Result<std::uint64_t> CudaRenderer::Impl::separate(const DeviceScene::Storage& scene, const cuda::ViewParameters& view,
                                                   const RenderOptions& options, bool narrow, CudaStream stream) {
  const auto n = static_cast<std::uint32_t>(scene.n);
  Status ok = device_status(cudaMemsetAsync(counters.as<void>(), 0, sizeof(cuda::Counters), stream),
                            "counters could not be cleared");
  if (ok) {
    ok = cuda::launch_project({scene.attributes, n, view, options.extent, splats.as<cuda::ScreenSplat>(),
                               covers.as<void>(), tiles.as<std::uint32_t>(), counters.as<cuda::Counters>()},
                              stream);
  }
  if (ok) ok = mark(kProjected, options, stream);
  if (ok) {
    ok = cuda::launch_sum(tiles.as<std::uint32_t>(), sums.as<std::uint64_t>(), n, sum_temporary.as<void>(),
                          sum_temporary.bytes(), stream);
  }
  if (ok) ok = fetch(&host->counters, counters.as<void>(), sizeof(cuda::Counters), stream);
  if (ok && n > 0) ok = fetch(&host->pairs, sums.as<std::uint64_t>() + n - 1, sizeof(std::uint64_t), stream);
  if (ok) ok = wait(stream);
  if (!ok) return tl::unexpected(ok.error());
  const std::uint64_t pairs = n == 0 ? 0 : host->pairs;
  if (pairs > kMaxPairs) return pairs;
  const std::uint64_t capacity = pair_arrays(narrow).capacity;
  if (pairs > capacity) ok = reserve_pairs(pairs, detail::with_room_to_grow(pairs, capacity, kMaxPairs), narrow);
  if (ok) {
    ok = cuda::launch_duplicate({n, view, options.extent, splats.as<cuda::ScreenSplat>(), covers.as<void>(),
                                 sums.as<std::uint64_t>(), pair_arrays(narrow)},
                                stream);
  }
  if (!ok) return tl::unexpected(ok.error());
  return pairs;
}

Status CudaRenderer::Impl::order(const cuda::ViewParameters& view, std::uint64_t pairs, bool narrow,
                                 const RenderOptions& options, CudaStream stream, cuda::SortBuffers& sorted) {
  sorted = {keys.as<void>(), spare_keys.as<void>(), gaussians.as<std::uint32_t>(), spare_gaussians.as<std::uint32_t>(),
            narrow};
  Status ok = mark(kDuplicated, options, stream);
  if (ok) {
    ok = cuda::launch_sort(sorted, pairs, view.key.bits(), sort_temporary.as<void>(), sort_temporary.bytes(), stream);
  }
  if (ok) ok = mark(kSorted, options, stream);
  const auto n_tiles = static_cast<std::uint32_t>(view.grid.columns * view.grid.rows);
  if (ok) {
    ok = cuda::launch_ranges(sorted.keys, narrow, pairs, view.key.depth_bits, ranges.as<cuda::TileRange>(), n_tiles,
                             stream);
  }
  if (ok) ok = mark(kRanged, options, stream);
  return ok;
}

// The original's and the paper's pipelines: pairs, one sort over the frame, ranges, pixels.
Result<std::uint64_t> CudaRenderer::Impl::sorted(const DeviceScene::Storage& scene, const Camera& camera,
                                                 const DeviceTarget& target, const cuda::ViewParameters& view,
                                                 const RenderOptions& options, CudaStream stream) {
  const bool narrow = view.key.bits() <= 32;
  const bool is_separate = options.cuda.front_end == CudaOptions::FrontEnd::separate;
  const auto n_tiles = static_cast<std::uint64_t>(view.grid.columns) * static_cast<std::uint64_t>(view.grid.rows);
  Status ok = reserve_scene(scene.n, is_separate, options.cuda.deterministic);
  if (ok && pair_arrays(narrow).capacity == 0) {
    ok = reserve_pairs(kFirstPairs, std::clamp(4 * scene.n, kFirstPairs, kMaxPairs), narrow);
  }
  if (ok) ok = ranges.reserve(n_tiles * sizeof(cuda::TileRange));
  if (ok) ok = mark(kStart, options, stream);
  if (!ok) return tl::unexpected(ok.error());

  const auto pairs =
      is_separate ? separate(scene, view, options, narrow, stream) : fused(scene, view, options, narrow, stream);
  if (!pairs || *pairs > kMaxPairs) return pairs;
  cuda::SortBuffers ordered{};
  ok = order(view, *pairs, narrow, options, stream, ordered);
  if (ok) {
    ok = cuda::launch_blend({ranges.as<cuda::TileRange>(), ordered.gaussians, splats.as<cuda::ScreenSplat>(), view.grid,
                             camera.width, camera.height, background_of(options), arrays_of(target),
                             options.cuda.count_pairs ? counters.as<cuda::Counters>() : nullptr, options.exponent,
                             options.exp, options.cuda.pixels_per_thread},
                            stream);
  }
  if (ok) ok = mark(kBlended, options, stream);
  if (!ok) return tl::unexpected(ok.error());
  return pairs;
}

// Room for so many entries, runs and large Gaussians, and for more of those that do not fit, if there is memory.
Status CudaRenderer::Impl::reserve_turbo(std::uint64_t n_entries, std::uint64_t n_runs, std::uint64_t n_large,
                                         std::uint64_t n_in_cells) {
  struct Need {
    DeviceBuffer& buffer;
    std::uint64_t n, size;
    std::uint64_t held() const { return buffer.bytes() / size; }
  };
  std::vector<Need> needs;
  for (const Need& need :
       {Need{turbo_entries, n_entries, sizeof(cuda::TurboEntry)},
        Need{turbo_scratch, n_entries, sizeof(cuda::TurboEntry)}, Need{turbo_runs, n_runs, sizeof(cuda::TurboTileRun)},
        Need{tile_runs, n_runs, sizeof(cuda::TurboRun)},
        Need{turbo_large, n_large, sizeof(cuda::TurboLargeGaussian) + sizeof(cuda::TurboBox)},
        Need{cell_gaussians, n_in_cells, sizeof(std::uint32_t)}}) {
    if (need.n > need.held()) needs.push_back(need);
  }
  return detail::reserve_growing([&](bool is_generous) {
    Status ok;
    for (const Need& need : needs) {
      const std::uint64_t n = is_generous ? detail::with_room_to_grow(need.n, need.held(), kMaxPairs) : need.n;
      if (ok) ok = need.buffer.reserve(n * need.size);
    }
    if (ok) ok = long_lists.reserve(long_sizes().bytes());
    for (const Need& need : needs) {
      if (!ok) need.buffer = {};  // what has grown would keep the memory that the others need
    }
    return ok;
  });
}

// Room for what is known before the frame, and a guess at the rest for the first.
Status CudaRenderer::Impl::prepare_turbo(const TurboFrame& f) {
  const std::uint64_t n = f.scene.size(), n_tiles = turbo_arrays(f).n_tiles;
  Status ok = splats.reserve(n * sizeof(cuda::ScreenSplat));
  if (ok) ok = turbo_state.reserve(cuda::TurboState::bytes(static_cast<std::uint32_t>(n_tiles)));
  if (ok) ok = lists.reserve(n_tiles * sizeof(cuda::TurboList));
  if (ok) ok = classes.reserve(n_tiles * cuda::kTurboClasses * sizeof(std::uint32_t));
  if (ok) ok = cells.reserve(n_tiles * cuda::kTurboCells * sizeof(cuda::TurboCell));
  if (!ok || turbo_entries.bytes() > 0) return ok;
  return detail::reserve_growing([&](bool is_generous) {
    const std::uint64_t first = is_generous ? std::max(kFirstPairs, 2 * n) : kFirstPairs;
    return reserve_turbo(first, first / 4, first / 32, 3 * first);
  });
}

std::uint64_t CudaRenderer::Impl::entry_capacity() const {
  return std::min(turbo_entries.bytes(), turbo_scratch.bytes()) / sizeof(cuda::TurboEntry);
}
std::uint64_t CudaRenderer::Impl::run_capacity() const {
  return std::min(turbo_runs.bytes() / sizeof(cuda::TurboTileRun), tile_runs.bytes() / sizeof(cuda::TurboRun));
}

cuda::TurboArrays CudaRenderer::Impl::turbo_arrays(const TurboFrame& f) const {
  cuda::TurboArrays a{};
  a.n_tiles = static_cast<std::uint32_t>(f.view.grid.columns * f.view.grid.rows);
  a.state = turbo_state.as<cuda::TurboState>();
  a.entries = turbo_entries.as<cuda::TurboEntry>();
  a.runs = turbo_runs.as<cuda::TurboTileRun>();
  a.tile_runs = tile_runs.as<cuda::TurboRun>();
  a.lists = lists.as<cuda::TurboList>();
  a.classes = classes.as<std::uint32_t>();
  a.scratch = turbo_scratch.as<cuda::TurboEntry>();
  a.large_gaussians = turbo_large.as<cuda::TurboLargeGaussian>();
  a.entry_capacity = entry_capacity();
  a.run_capacity = run_capacity();
  a.large_capacity = turbo_large.bytes() / (sizeof(cuda::TurboLargeGaussian) + sizeof(cuda::TurboBox));
  a.large_boxes = reinterpret_cast<cuda::TurboBox*>(a.large_gaussians + a.large_capacity);
  long_sizes().lay_out(long_lists.as<void>(), a);
  a.cells = cells.as<cuda::TurboCell>();
  a.cell_gaussians = cell_gaussians.as<std::uint32_t>();
  a.cell_capacity = cell_gaussians.bytes() / sizeof(std::uint32_t);
  return a;
}

// Long lists are few and take several steps: beside the order of the others, which would have to wait for them.
Status CudaRenderer::Impl::order_turbo(const cuda::TurboArrays& arrays, math::TileGrid grid, CudaStream on) {
  const auto record = [](cudaEvent_t event, CudaStream stream) {
    return device_status(cudaEventRecord(event, stream), "an event could not be recorded");
  };
  const auto wait_for = [](cudaEvent_t event, CudaStream stream) {
    return device_status(cudaStreamWaitEvent(stream, event), "a stream could not be made to wait");
  };
  Status ok = record(listed, on);
  if (ok) ok = wait_for(listed, beside);
  if (!ok) return ok;
  ok = cuda::launch_turbo_long_lists(arrays, grid, &host->turbo, beside);
  if (ok) ok = cuda::launch_turbo_units(arrays, beside);
  // Joined after an error, too: the next frame waits for `on` alone.
  Status joined = record(ordered_long, beside);
  if (ok) ok = cuda::launch_turbo_order(arrays, grid, &host->turbo, on);
  if (joined) joined = wait_for(ordered_long, on);
  if (ok) ok = joined;
  return ok ? record(counted, on) : ok;
}

// The frame's kernels, on its stream or on one that captures them. Nothing is waited for.
Status CudaRenderer::Impl::launch_turbo(const TurboFrame& f, CudaStream on) {
  const cuda::TurboArrays arrays = turbo_arrays(f);
  const auto mark_stage = [&](Mark m) { return f.options.cuda.graph ? Status() : mark(m, f.options, on); };
  Status ok = device_status(cudaMemsetAsync(arrays.state, 0, cuda::TurboState::bytes(arrays.n_tiles), on),
                            "the frame's state could not be cleared");
  if (ok) {
    const DeviceScene::Storage& scene = stored(f.scene);
    ok = cuda::launch_turbo_emit(
        {scene.attributes, static_cast<std::uint32_t>(scene.n), f.view, splats.as<cuda::ScreenSplat>(), arrays}, on);
  }
  if (ok) ok = mark_stage(kProjected);
  if (ok) ok = cuda::launch_turbo_lists(arrays, &host->turbo, on);
  if (ok) ok = mark_stage(kDuplicated);
  if (ok) ok = order_turbo(arrays, f.view.grid, on);
  for (const Mark m : {kSorted, kRanged}) {
    if (ok) ok = mark_stage(m);
  }
  if (ok) {
    ok = cuda::launch_turbo_blend({arrays, splats.as<cuda::ScreenSplat>(), f.view.grid, f.width, f.height,
                                   background_of(f.options), arrays_of(f.target), f.options.cuda.count_pairs,
                                   f.options.cuda.tensor_cores && f.options.low_pass >= kTensorLowPass},
                                  on);
  }
  return ok;
}

Status CudaRenderer::Impl::queue_turbo(const TurboFrame& f) {
  const bool is_graph = f.options.cuda.graph;
  Status ok = begin(f.stream);
  if (ok && is_graph) ok = graph.capture([&](CudaStream on) { return launch_turbo(f, on); });
  if (ok) ok = mark(kStart, f.options, f.stream);
  if (ok) ok = is_graph ? graph.launch(f.stream) : launch_turbo(f, f.stream);
  if (ok) ok = mark(kBlended, f.options, f.stream);
  const Status ended = end(f.stream);
  return ok ? ended : ok;
}

// Entries of a queued frame. It was queued before their number was known; if they did not fit, which the host learns
// while the frame is still being made, lists or cells were left empty and it is made again.
Result<std::uint64_t> CudaRenderer::Impl::settle(const TurboFrame& frame) {
  for (;;) {
    // Events within a graph are not there to be waited for.
    Status ok = device_status(cudaEventSynchronize(frame.options.cuda.graph ? finished : counted), "a kernel failed");
    if (!ok) return tl::unexpected(ok.error());
    const cuda::TurboState& seen = host->turbo;
    const cuda::TurboArrays arrays = turbo_arrays(frame);
    host->counters = seen.counters;
    const std::uint64_t n = seen.counters.instances;
    const bool all_large =
        seen.n_large_gaussians <= arrays.large_capacity;  // otherwise the others' entries are not counted
    const bool all_listed = all_large && n <= arrays.entry_capacity && seen.runs <= arrays.run_capacity;
    if (std::max(n, seen.in_cells) > kMaxPairs) return std::max(n, seen.in_cells);
    if (all_listed && seen.in_cells <= arrays.cell_capacity) return n;
    ok = device_status(cudaEventSynchronize(finished), "a kernel failed");  // it uses the workspace until then
    if (!ok) return tl::unexpected(ok.error());
    // Counts without all large Gaussians are too low to be worth memory.
    ok = all_large ? reserve_turbo(n, seen.runs, 0, seen.in_cells) : reserve_turbo(0, 0, seen.n_large_gaussians, 0);
    if (ok) ok = queue_turbo(frame);
    if (!ok) return tl::unexpected(ok.error());
  }
}

// What a frame has cost, once all that options ask for is known.
Result<FrameStats> CudaRenderer::Impl::outcome(std::uint64_t n_gaussians, std::uint64_t pairs,
                                               const cuda::ViewParameters& view, const RenderOptions& options,
                                               CudaStream stream) {
  if (pairs > kMaxPairs) {
    return too_many(pairs);
  }
  const bool is_turbo = draws_turbo(options, n_gaussians);
  FrameStats stats;
  stats.gaussians = n_gaussians;
  stats.visible = host->counters.visible;
  stats.instances = pairs;
  stats.depth_bits = view.key.quantized ? view.key.depth_bits : 0;
  stats.key_bits = view.key.bits();
  stats.bytes = bytes();
  Status ok;
  if (options.cuda.count_pairs) {
    const void* const from = is_turbo ? &turbo_state.as<cuda::TurboState>()->counters : counters.as<void>();
    ok = fetch(&host->counters, from, sizeof(cuda::Counters), stream);
  }
  if (ok && (options.cuda.timings || options.cuda.count_pairs)) ok = wait(stream);
  if (!ok) return tl::unexpected(ok.error());
  if (options.cuda.count_pairs) {
    stats.evaluated = host->counters.evaluated;
    stats.blended = host->counters.blended;
  }
  if (options.cuda.timings) {
    const auto between = [&](Mark from, Mark to) {
      float ms = 0;
      if (ok) ok = device_status(cudaEventElapsedTime(&ms, events[from], events[to]), "a stage has no time");
      return static_cast<double>(ms);
    };
    if (options.cuda.stage_timings && !(is_turbo && options.cuda.graph)) {
      stats.project_ms = between(kStart, kProjected);
      stats.sort_ms = between(kDuplicated, kSorted);
      stats.bin_ms = between(kProjected, kDuplicated) + between(kSorted, kRanged);
      stats.blend_ms = between(kRanged, kBlended);
    }
    stats.total_ms = between(kStart, kBlended);
    if (!ok) return tl::unexpected(ok.error());
  }
  last = stats;
  return stats;
}

Result<FrameStats> CudaRenderer::render(const DeviceScene& scene, const Camera& camera, const DeviceTarget& target,
                                        const RenderOptions& options, CudaStream stream) {
  if (const auto ok = validate(camera); !ok) return tl::unexpected(ok.error());
  if (const auto ok = detail::validate(options); !ok) return tl::unexpected(ok.error());
  if (const auto ok = check(target); !ok) return tl::unexpected(ok.error());
  Impl& w = *impl_;
  if (w.open) {
    const Impl::TurboFrame before = *std::exchange(w.open, std::nullopt);
    const auto settled = w.settle(before);
    if (!settled) return tl::unexpected(settled.error());
    if (*settled > kMaxPairs) return too_many(*settled);
  }
  const DeviceScene::Storage& storage = Impl::stored(scene);

  cuda::ViewParameters view{};
  view.view = detail::make_view(camera, options);
  view.grid = math::tile_grid(camera.width, camera.height);
  view.low_pass = options.low_pass;
  view.anti_aliasing = options.anti_aliasing;
  view.sh_degree = std::min(storage.sh_degree, options.sh_degree_limit);
  const bool is_turbo = draws_turbo(options, storage.n);
  if (is_turbo) {
    view.grid = math::tile_grid<cuda::kTurboTile>(camera.width, camera.height);
  } else {
    const auto n_tiles = static_cast<std::uint32_t>(view.grid.columns * view.grid.rows);
    view.key = math::key_layout(options.depth_order, options.depth_bits, n_tiles);
  }
  if (view.key.quantized) {
    view.quantizer = math::make_depth_quantizer(options.depth_mapping, view.key.depth_bits, options.depth_range[0],
                                                options.depth_range[1]);
  }

  w.last = {};
  std::uint64_t n_pairs = 0;
  if (is_turbo) {
    const Impl::TurboFrame frame{scene, camera.width, camera.height, target, view, options, stream};
    Status ok = w.prepare_turbo(frame);
    if (ok) ok = w.queue_turbo(frame);
    if (!ok) return tl::unexpected(ok.error());
    if (options.cuda.asynchronous) {
      w.open = frame;
      FrameStats queued;
      queued.gaussians = storage.n;
      queued.bytes = w.bytes();
      return queued;
    }
    const auto pairs = w.settle(frame);
    if (!pairs) return tl::unexpected(pairs.error());
    n_pairs = *pairs;
  } else {
    if (const auto ok = w.begin(stream); !ok) return tl::unexpected(ok.error());
    const auto pairs = w.sorted(storage, camera, target, view, options, stream);
    const Status ended = w.end(stream);
    if (!pairs) return tl::unexpected(pairs.error());
    if (!ended) return tl::unexpected(ended.error());
    n_pairs = *pairs;
  }
  return w.outcome(storage.n, n_pairs, view, options, stream);
}

Result<FrameStats> CudaRenderer::finish() {
  Impl& w = *impl_;
  if (w.open) {
    const Impl::TurboFrame frame = *std::exchange(w.open, std::nullopt);
    const auto pairs = w.settle(frame);
    if (!pairs) return tl::unexpected(pairs.error());
    const auto stats = w.outcome(frame.scene.size(), *pairs, frame.view, frame.options, frame.stream);
    if (!stats) return stats;
  }
  if (const auto ok = device_status(cudaEventSynchronize(w.finished), "a kernel failed"); !ok) {
    return tl::unexpected(ok.error());
  }
  return w.last;
}

}  // namespace rgs
