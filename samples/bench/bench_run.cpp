// bench_run.cpp - frames of one configuration on the GPU, and what GPU it is.
// SPDX-License-Identifier: Apache-2.0
#include "bench_run.hpp"

#include <cuda_runtime_api.h>

#include <algorithm>
#include <memory>
#include <optional>

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

// Medians of the times of frames of one camera; their counts are all the same.
Result<FrameStats> measure_camera(CudaRenderer& renderer, const DeviceScene& scene, const Camera& camera,
                                  const DeviceTarget& target, const RenderOptions& options, int frames) {
  constexpr int kUnmeasured = 10;
  constexpr double FrameStats::*kTimes[] = {&FrameStats::project_ms, &FrameStats::sort_ms, &FrameStats::bin_ms,
                                            &FrameStats::blend_ms, &FrameStats::total_ms};
  std::vector<double> times[std::size(kTimes)];
  FrameStats last;
  for (int f = 0; f < kUnmeasured + frames; ++f) {
    const auto stats = renderer.render(scene, camera, target, options);
    if (!stats) return stats;
    last = *stats;
    for (std::size_t k = 0; f >= kUnmeasured && k < std::size(kTimes); ++k) times[k].push_back(last.*kTimes[k]);
  }
  for (std::size_t k = 0; k < std::size(kTimes); ++k) last.*kTimes[k] = median(times[k]);
  return last;
}

void add(FrameStats& sum, const FrameStats& s) {
  sum.project_ms += s.project_ms, sum.sort_ms += s.sort_ms, sum.bin_ms += s.bin_ms;
  sum.blend_ms += s.blend_ms, sum.total_ms += s.total_ms;
  sum.visible += s.visible, sum.instances += s.instances;
  sum.evaluated += s.evaluated, sum.blended += s.blended;
  sum.gaussians = s.gaussians, sum.depth_bits = s.depth_bits, sum.key_bits = s.key_bits;
  sum.bytes = std::max(sum.bytes, s.bytes);
}

void divide(FrameStats& sum, std::size_t n) {
  const auto d = static_cast<double>(n);
  sum.project_ms /= d, sum.sort_ms /= d, sum.bin_ms /= d, sum.blend_ms /= d, sum.total_ms /= d;
  sum.visible /= n, sum.instances /= n, sum.evaluated /= n, sum.blended /= n;
}

}  // namespace

Result<Timing> measure(const Configuration& c, const DeviceScenes& scenes, std::span<const Camera> cameras,
                       int frames) {
  auto renderer = CudaRenderer::create();
  if (!renderer) return tl::unexpected(renderer.error());
  std::size_t floats = 0;
  for (const Camera& camera : cameras) floats = std::max(floats, floats_of(camera) / 3 * floats_a_pixel(c.packed));
  const auto memory = device_floats(floats);
  if (!memory) return tl::unexpected(memory.error());
  const DeviceTarget target = target_of(*memory, c.packed);

  Timing timing;
  for (const Camera& camera : cameras) {
    RenderOptions options = c.options;
    options.measure.timings = true;
    auto stats = measure_camera(*renderer, scenes.of(c), camera, target, options, frames);
    if (!stats) return tl::unexpected(stats.error());
    options.measure.stage_timings = false;  // frames of their own for the total: events between the stages take time
    const auto whole = measure_camera(*renderer, scenes.of(c), camera, target, options, frames);
    if (!whole) return tl::unexpected(whole.error());
    stats->total_ms = whole->total_ms;
    options.measure.count_pairs = true;  // in a frame of its own: counting takes time
    const auto counted = renderer->render(scenes.of(c), camera, target, options);
    if (!counted) return tl::unexpected(counted.error());
    stats->evaluated = counted->evaluated, stats->blended = counted->blended;
    add(timing.mean, *stats);
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
