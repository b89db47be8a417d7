// bench_run.cpp - frames of one configuration on the GPU, and what GPU it is.
// SPDX-License-Identifier: Apache-2.0
#include "bench_run.hpp"

#include <cuda_runtime_api.h>

#include <algorithm>
#include <chrono>
#include <iterator>
#include <limits>
#include <memory>
#include <optional>

#include "stress_views.hpp"

namespace rgs::bench {
namespace {

struct FreeDevice {
  void operator()(float* memory) const { cudaFree(memory); }
};
using DeviceFloats = std::unique_ptr<float, FreeDevice>;

Result<DeviceFloats> device_floats(std::size_t n) {
  float* memory = nullptr;
  if (cudaMalloc(reinterpret_cast<void**>(&memory), n * sizeof(float)) != cudaSuccess) {
    return make_error(Errc::device_out_of_memory, Error::kNone, "the device has not this much memory left",
                      n * sizeof(float));
  }
  return DeviceFloats(memory);
}

std::size_t floats_of(const Camera& camera) {
  return 3 * static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
}

Result<std::vector<float>> downloaded(const DeviceFloats& memory, std::size_t n) {
  std::vector<float> values(n);
  if (cudaMemcpy(values.data(), memory.get(), n * sizeof(float), cudaMemcpyDeviceToHost) != cudaSuccess) {
    return make_error(Errc::device_failed, Error::kNone, "a frame could not be copied from the device");
  }
  return values;
}

double median(std::vector<double>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// In device memory of floats_a_pixel() floats a pixel.
DeviceTarget target_of(const DeviceFloats& memory, const std::optional<math::PixelFormat>& packed) {
  DeviceTarget target;
  if (!packed) {
    target.rgb = memory.get();
  } else {
    target.packed = memory.get();
    target.format = *packed;
  }
  return target;
}
// 3, or of a packed pixel's bytes 2 or 1.
std::size_t floats_a_pixel(const std::optional<math::PixelFormat>& packed) {
  return pixel_bytes(packed) / sizeof(float);
}

struct FreeStream {
  void operator()(CudaStream stream) const { cudaStreamDestroy(stream); }
};
using OwnedStream = std::unique_ptr<CUstream_st, FreeStream>;

struct FreeEvent {
  void operator()(cudaEvent_t event) const { cudaEventDestroy(event); }
};
using OwnedEvent = std::unique_ptr<CUevent_st, FreeEvent>;

Status check(cudaError_t error) {
  if (error == cudaSuccess) return {};
  cudaGetLastError();
  return make_error(Errc::device_failed, Error::kNone, "a frame could not be timed", Error::kNone,
                    static_cast<std::uint64_t>(error));
}

// A caller's stream, and events around what it queues there.
class Stopwatch {
 public:
  Status create() {
    CudaStream stream = nullptr;
    Status ok = check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
    stream_.reset(stream);
    for (OwnedEvent* event : {&start_, &end_}) {
      cudaEvent_t made = nullptr;
      if (ok) ok = check(cudaEventCreate(&made));
      event->reset(made);
    }
    return ok;
  }
  CudaStream stream() const { return stream_.get(); }
  Status start() const { return check(cudaEventRecord(start_.get(), stream_.get())); }
  /// Waits. Milliseconds since start().
  Result<double> stop() const {
    float ms = 0;
    Status ok = check(cudaEventRecord(end_.get(), stream_.get()));
    if (ok) ok = check(cudaEventSynchronize(end_.get()));
    if (ok) ok = check(cudaEventElapsedTime(&ms, start_.get(), end_.get()));
    if (!ok) return tl::unexpected(ok.error());
    return static_cast<double>(ms);
  }

 private:
  OwnedStream stream_;
  OwnedEvent start_, end_;
};

using Clock = std::chrono::steady_clock;
double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

// Frames of one mode, scene, camera and target.
struct Shot {
  CudaRenderer& renderer;
  const DeviceScene& scene;
  const Camera& camera;
  const DeviceTarget& target;

  Result<FrameStats> render(const RenderOptions& options, CudaStream stream = nullptr) const {
    return renderer.render(scene, camera, target, options, stream);
  }
};

// Frames before those that count: memory has grown, clocks are up. How many of them fit into the time for one loop.
Result<int> warm_up(const Shot& shot, const RenderOptions& options, const Effort& loop) {
  constexpr int kUnmeasured = 10;
  const auto start = Clock::now();
  double fastest = std::numeric_limits<double>::infinity();
  for (int f = 0; f < kUnmeasured && (f == 0 || ms_since(start) < 1e3 * loop.seconds); ++f) {
    const auto frame = Clock::now();
    const auto stats = shot.render(options);
    if (!stats) return tl::unexpected(stats.error());
    fastest = std::min(fastest, ms_since(frame));
  }
  return frames_within(loop.seconds, fastest, loop.frames);
}

// Medians of the times that the library takes; counts are all the same.
Result<FrameStats> measure_inside(const Shot& shot, const RenderOptions& options, int frames) {
  constexpr double FrameStats::*kTimes[] = {&FrameStats::project_ms, &FrameStats::sort_ms, &FrameStats::bin_ms,
                                            &FrameStats::blend_ms, &FrameStats::total_ms};
  std::vector<double> times[std::size(kTimes)];
  FrameStats last;
  for (int f = 0; f < frames; ++f) {
    const auto stats = shot.render(options);
    if (!stats) return stats;
    last = *stats;
    for (std::size_t k = 0; k < std::size(kTimes); ++k) times[k].push_back(last.*kTimes[k]);
  }
  for (std::size_t k = 0; k < std::size(kTimes); ++k) last.*kTimes[k] = median(times[k]);
  return last;
}

// The times that a caller takes; nothing in the options asks the library for any.
Result<OutsideTimes> measure_outside(const Shot& shot, RenderOptions options, int frames, const Stopwatch& watch) {
  std::vector<double> clocks, events;
  for (int f = 0; f < frames; ++f) {
    const auto start = Clock::now();
    if (const auto ok = watch.start(); !ok) return tl::unexpected(ok.error());
    if (const auto stats = shot.render(options, watch.stream()); !stats) return tl::unexpected(stats.error());
    const auto ms = watch.stop();
    if (!ms) return tl::unexpected(ms.error());
    clocks.push_back(ms_since(start));
    events.push_back(*ms);
  }
  options.turbo.asynchronous = true;
  const auto in_flight = static_cast<int>(CudaRendererOptions().frames_in_flight);
  for (int f = 0; f < in_flight; ++f) {  // makes room for what overlaps
    if (const auto stats = shot.render(options, watch.stream()); !stats) return tl::unexpected(stats.error());
  }
  if (const auto last = shot.renderer.finish(); !last) return tl::unexpected(last.error());
  if (const auto ok = watch.start(); !ok) return tl::unexpected(ok.error());
  for (int f = 0; f < frames; ++f) {
    if (const auto stats = shot.render(options, watch.stream()); !stats) return tl::unexpected(stats.error());
  }
  const auto all = watch.stop();
  if (!all) return tl::unexpected(all.error());
  if (const auto last = shot.renderer.finish(); !last) return tl::unexpected(last.error());
  double host_ms = 0;
  for (int f = 0; f < frames; ++f) {
    const auto start = Clock::now();
    if (const auto stats = shot.render(options, watch.stream()); !stats) return tl::unexpected(stats.error());
    host_ms += ms_since(start);
    if ((f + 1) % in_flight != 0) continue;  // the next call need not wait
    if (const auto last = shot.renderer.finish(); !last) return tl::unexpected(last.error());
  }
  if (const auto last = shot.renderer.finish(); !last) return tl::unexpected(last.error());
  return OutsideTimes{median(clocks), median(events), *all / frames, 1e3 * host_ms / frames};
}

void add(FrameStats& sum, const FrameStats& s) {
  sum.project_ms += s.project_ms, sum.sort_ms += s.sort_ms, sum.bin_ms += s.bin_ms;
  sum.blend_ms += s.blend_ms, sum.total_ms += s.total_ms;
  sum.visible += s.visible, sum.instances += s.instances;
  sum.evaluated += s.evaluated, sum.blended += s.blended;
  sum.depth_resolution = std::max(sum.depth_resolution, s.depth_resolution);
  sum.gaussians += s.gaussians, sum.pages += s.pages;
  sum.depth_bits = s.depth_bits, sum.key_bits = s.key_bits;
  sum.bytes = std::max(sum.bytes, s.bytes);
}

void divide(FrameStats& sum, std::size_t n) {
  const auto d = static_cast<double>(n);
  sum.project_ms /= d, sum.sort_ms /= d, sum.bin_ms /= d, sum.blend_ms /= d, sum.total_ms /= d;
  sum.gaussians /= n, sum.pages /= n;
  sum.visible /= n, sum.instances /= n, sum.evaluated /= n, sum.blended /= n;
}

}  // namespace

Result<Timing> measure(const Configuration& c, const DeviceScenes& scenes, std::span<const Camera> cameras,
                       const Effort& effort) {
  auto renderer = CudaRenderer::create();
  if (!renderer) return tl::unexpected(renderer.error());
  Stopwatch watch;
  if (const auto ok = watch.create(); !ok) return tl::unexpected(ok.error());
  std::size_t floats = 0;
  for (const Camera& camera : cameras) floats = std::max(floats, floats_of(camera) / 3 * floats_a_pixel(c.packed));
  const auto memory = device_floats(floats);
  if (!memory) return tl::unexpected(memory.error());
  const DeviceTarget target = target_of(*memory, c.packed);

  // Warm-up, stages, total, one at a time, back to back, the host's calls.
  constexpr double kLoops = 6;
  const auto n = static_cast<double>(cameras.size());
  const Effort loop{effort.frames, effort.seconds / n / kLoops};
  Timing timing;
  timing.frames = effort.frames;
  for (const Camera& camera : cameras) {
    const Shot shot{*renderer, scenes.of(c), camera, target};
    RenderOptions options = c.options;
    options.measure.timings = true;
    const auto frames = warm_up(shot, options, loop);
    if (!frames) return tl::unexpected(frames.error());
    auto stats = measure_inside(shot, options, *frames);
    if (!stats) return tl::unexpected(stats.error());
    options.measure.stage_timings = false;  // frames of their own for the total: events between the stages take time
    const auto whole = measure_inside(shot, options, *frames);
    if (!whole) return tl::unexpected(whole.error());
    stats->total_ms = whole->total_ms;
    const auto outside = measure_outside(shot, c.options, *frames, watch);
    if (!outside) return tl::unexpected(outside.error());
    options.measure.count_pairs = true;  // in a frame of its own: counting takes time
    const auto counted = shot.render(options);
    if (!counted) return tl::unexpected(counted.error());
    stats->evaluated = counted->evaluated, stats->blended = counted->blended;
    add(timing.mean, *stats);
    if (stats->pages > 0) timing.drawn.push_back({camera.name, stats->pages, stats->gaussians});
    timing.outside.eager_clock_ms += outside->eager_clock_ms / n;
    timing.outside.eager_events_ms += outside->eager_events_ms / n;
    timing.outside.queued_ms += outside->queued_ms / n;
    timing.outside.host_us += outside->host_us / n;
    timing.frames = std::min(timing.frames, *frames);
    timing.fastest_ms = timing.fastest_ms == 0 ? stats->total_ms : std::min(timing.fastest_ms, stats->total_ms);
    timing.slowest_ms = std::max(timing.slowest_ms, stats->total_ms);
  }
  divide(timing.mean, cameras.size());
  timing.peak_bytes = scenes.of(c).bytes() + renderer->bytes() + floats * sizeof(float);
  return timing;
}

namespace {

Result<Image> picture(CudaRenderer& renderer, const Configuration& c, const DeviceScenes& scenes, const Camera& camera,
                      const DeviceFloats& memory) {
  DeviceTarget target;
  target.rgb = memory.get();
  const auto stats = renderer.render(scenes.of(c), camera, target, c.options);
  if (!stats) return tl::unexpected(stats.error());
  auto pixels = downloaded(memory, floats_of(camera));
  if (!pixels) return tl::unexpected(pixels.error());
  return Image{camera.width, camera.height, 3, *std::move(pixels)};
}

Result<double> distance_ahead(CudaRenderer& renderer, const Configuration& c, const DeviceScenes& scenes,
                              const Camera& camera) {
  const std::size_t n = floats_of(camera) / 3;
  const auto memory = device_floats(n);
  if (!memory) return tl::unexpected(memory.error());
  DeviceTarget target;
  target.depth = memory->get();
  const auto stats = renderer.render(scenes.of(c), camera, target, c.options);
  if (!stats) return tl::unexpected(stats.error());
  const auto depth = downloaded(*memory, n);
  if (!depth) return tl::unexpected(depth.error());
  return look_at_distance(*depth);
}

}  // namespace

Result<std::vector<Image>> pictures(const Configuration& c, const DeviceScenes& scenes,
                                    std::span<const Camera> cameras) {
  auto renderer = CudaRenderer::create();
  if (!renderer) return tl::unexpected(renderer.error());
  std::vector<Image> out;
  for (const Camera& camera : cameras) {
    const auto memory = device_floats(floats_of(camera));
    if (!memory) return tl::unexpected(memory.error());
    auto image = picture(*renderer, c, scenes, camera, *memory);
    if (!image) return tl::unexpected(image.error());
    out.push_back(*std::move(image));
  }
  return out;
}

Result<OrbitReport> orbit(std::span<const Configuration> modes, const DeviceScenes& scenes, const Camera& camera,
                          double degrees, int frames) {
  // One renderer for all modes: none leaves anything in it that the next one would see.
  auto renderer = CudaRenderer::create();
  if (!renderer) return tl::unexpected(renderer.error());
  const auto memory = device_floats(floats_of(camera));
  if (!memory) return tl::unexpected(memory.error());
  std::vector<Configuration> shown;
  std::vector<std::string> names;
  for (const Configuration& c : modes) {
    if (c.step) continue;
    shown.push_back(c);
    names.push_back(c.name);
  }
  const auto distance = distance_ahead(*renderer, shown.front(), scenes, camera);
  if (!distance) return tl::unexpected(distance.error());
  auto rows = follow(turntable(camera, *distance, degrees, frames), names, [&](std::size_t mode, const Camera& view) {
    return picture(*renderer, shown[mode], scenes, view, *memory);
  });
  if (!rows) return tl::unexpected(rows.error());
  return OrbitReport{camera.name, camera.width, camera.height, frames, degrees, *distance, *std::move(rows)};
}

Result<DeviceInfo> device_info() {
  int device = 0;
  cudaDeviceProp properties{};
  if (cudaGetDevice(&device) != cudaSuccess || cudaGetDeviceProperties(&properties, device) != cudaSuccess) {
    return make_error(Errc::device_failed, Error::kNone, "no CUDA device answers");
  }
  const auto kilohertz = [device](cudaDeviceAttr attribute) {
    int value = 0;
    return cudaDeviceGetAttribute(&value, attribute, device) == cudaSuccess ? value : 0;
  };
  DeviceInfo info;
  info.name = properties.name;
  info.capability_major = properties.major, info.capability_minor = properties.minor;
  info.multiprocessors = properties.multiProcessorCount;
  info.clock_mhz = 1e-3 * kilohertz(cudaDevAttrClockRate);
  info.memory_clock_mhz = 1e-3 * kilohertz(cudaDevAttrMemoryClockRate);
  info.memory_bytes = properties.totalGlobalMem;
  info.l2_bytes = static_cast<std::uint64_t>(properties.l2CacheSize);
  cudaDriverGetVersion(&info.driver_version);
  cudaRuntimeGetVersion(&info.runtime_version);
  return info;
}

}  // namespace rgs::bench
