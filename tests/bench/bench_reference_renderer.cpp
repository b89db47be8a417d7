// bench_reference_renderer.cpp - CPU frames: the scalar definition, vectors, threads and arithmetic options.
// SPDX-License-Identifier: Apache-2.0
//
//   rgs_bench_reference_renderer [--ply SCENE --cameras CAMERAS] [--view I] [--size WxH] [--gaussians N]
//                                [benchmark flags]
//
// Without a scene it renders the generated one. Counters: stage times of the last frame (ms), evaluated and blended
// pairs per second, attribute and workspace bytes. Compare rows of one run only.
#include <benchmark/benchmark.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

#include "rgs/camera_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/renderer.hpp"
#include "scene_generator.hpp"

namespace {

struct Input {
  rgs::Scene scene;
  rgs::Camera camera;
};

[[noreturn]] void stop(const char* what) {
  std::fprintf(stderr, "rgs_bench_reference_renderer: %s\n", what);
  std::exit(2);
}

template <class T>
T value_or_stop(rgs::Result<T> result) {
  if (!result) stop(result.error().what);
  return *std::move(result);
}

Input load(int argc, char** argv) {
  std::string ply, cameras_path;
  std::size_t view = 0;
  std::uint64_t n = 500'000;
  int width = 1280, height = 960;
  for (int i = 1; i < argc; ++i) {
    const std::string flag = argv[i];
    if (i + 1 == argc) stop("an option lacks its value");
    const char* const value = argv[++i];
    if (flag == "--ply") {
      ply = value;
    } else if (flag == "--cameras") {
      cameras_path = value;
    } else if (flag == "--view") {
      view = std::strtoul(value, nullptr, 10);
    } else if (flag == "--gaussians") {
      n = std::strtoull(value, nullptr, 10);
    } else if (flag == "--size") {
      if (std::sscanf(value, "%dx%d", &width, &height) != 2) stop("--size needs WxH");
    } else {
      stop("unknown option");
    }
  }
  if (ply.empty() != cameras_path.empty()) stop("--ply and --cameras go together");
  rgs::SplatCloud cloud;
  std::vector<rgs::Camera> cameras;
  if (ply.empty()) {
    const rgs::SceneGenerator generator(1, n, 3);
    std::vector<rgs::Splat> splats(n);
    generator.generate(0, splats);
    cloud.resize(n, 3);
    for (std::uint64_t i = 0; i < n; ++i) cloud.set(i, splats[i]);
    cameras = value_or_stop(rgs::parse_camera_json(rgs::scene_cameras_json())).cameras;
  } else {
    cloud = value_or_stop(rgs::read_ply(ply));
    cameras = value_or_stop(rgs::read_cameras(cameras_path));
  }
  if (view >= cameras.size()) stop("there is no such view");
  return {value_or_stop(rgs::Scene::load(std::move(cloud))), rgs::resized(cameras[view], width, height)};
}

void frame(benchmark::State& state, const Input& input, const rgs::RendererOptions& how,
           const rgs::RenderOptions& options) {
  auto renderer = value_or_stop(rgs::Renderer::create(how));
  const auto n_pixels = static_cast<std::size_t>(input.camera.width) * static_cast<std::size_t>(input.camera.height);
  std::vector<float> rgb(3 * n_pixels);
  const rgs::RenderTarget target{.rgb = rgb};
  value_or_stop(renderer.render(input.scene, input.camera, target, options));
  rgs::FrameStats stats;
  for (auto _ : state) stats = value_or_stop(renderer.render(input.scene, input.camera, target, options));
  const auto rate = [](std::uint64_t n) {
    return benchmark::Counter(static_cast<double>(n), benchmark::Counter::kIsIterationInvariantRate);
  };
  state.counters["evaluated/s"] = rate(stats.evaluated);
  state.counters["blended/s"] = rate(stats.blended);
  state.counters["project_ms"] = stats.project_ms;
  state.counters["sort_ms"] = stats.sort_ms;
  state.counters["bin_ms"] = stats.bin_ms;
  state.counters["blend_ms"] = stats.blend_ms;
  state.counters["scene_bytes"] = static_cast<double>(input.scene.bytes());
  state.counters["work_bytes"] = static_cast<double>(stats.bytes);
  state.SetLabel(renderer.backend_name());
}

}  // namespace

int main(int argc, char** argv) {
  benchmark::Initialize(&argc, argv);
  const Input input = load(argc, argv);
  const auto add = [&input](const std::string& name, rgs::RendererOptions how, rgs::RenderOptions options) {
    how.backend = rgs::Backend::cpu;
    benchmark::RegisterBenchmark(("frame/" + name).c_str(),
                                 [&input, how, options](benchmark::State& s) { frame(s, input, how, options); })
        ->Unit(benchmark::kMillisecond)
        ->MeasureProcessCPUTime()
        ->UseRealTime();
  };
  const auto with = [](rgs::PaperSteps steps) {
    steps.depth_order = rgs::math::DepthOrder::exact;
    return rgs::RenderOptions{.pipeline = rgs::Pipeline::paper, .paper = steps};
  };
  using enum rgs::math::Exponent;
  using enum rgs::math::Exp;
  add("scalar/1_thread", {.threads = 1, .simd = false}, {});
  add("simd/1_thread", {.threads = 1}, {});
  const int n_threads = static_cast<int>(std::max(2U, std::thread::hardware_concurrency()));
  for (int threads = 2; threads <= n_threads; threads *= 2) {
    add("simd/" + std::to_string(threads) + "_threads", {.threads = threads}, {});
  }
  add("simd/1_thread/square", {.threads = 1},
      with({.extent = rgs::math::Extent::square, .exponent = direct, .exp = exact}));
  add("simd/1_thread/folded", {.threads = 1}, with({.exponent = folded, .exp = exact}));
  add("simd/1_thread/folded_paper_exp", {.threads = 1}, with({.exponent = folded, .exp = paper}));
  benchmark::RunSpecifiedBenchmarks();
}
