// render_calls.cpp - draws pictures into arrays that Python holds, and lends arrays in GPU memory.
// SPDX-License-Identifier: Apache-2.0
#include <dlpack/dlpack.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "calls.hpp"
#include "rgs/camera_view.hpp"
#include "rgs/image.hpp"
#include "rgs/math/camera_models.hpp"
#include "rgs/math/coverage.hpp"
#include "rgs/renderer.hpp"

// Of Python's stable ABI; the process that has loaded this library holds them.
extern "C" int PyCapsule_IsValid(void* capsule, const char* name);
extern "C" void* PyCapsule_GetPointer(void* capsule, const char* name);

namespace rgs::python {
namespace {

// One call at a time; the caller sees to it.
struct HeldRenderer {
  Renderer renderer;
  std::vector<FrameStats> stats;  // of the pictures of the last call
};
using RendererHandle = std::shared_ptr<HeldRenderer>;

Json make_renderer(const Json& a) {
  const std::string device = a.at("device");
  RendererOptions options;
  options.backend = device == "cuda" ? Backend::cuda : device == "cpu" ? Backend::cpu : Backend::automatic;
  options.threads = a.at("threads");
  options.devices = a.at("devices").get<std::vector<int>>();
  auto renderer = take(Renderer::create(options));
  const char* const drawn_by = renderer.backend() == Backend::cuda ? "cuda" : "cpu";
  const std::string name = renderer.backend_name();
  give(a, RendererHandle(new HeldRenderer{std::move(renderer), {}}));
  return {{"device", drawn_by}, {"name", name}};
}

Json make_options(const Json& a) {
  RenderOptions options;
  options.background = a.at("background");
  options.near_plane = optional<float>(a, "near_plane").value_or(options.near_plane);
  options.far_plane = optional<float>(a, "far_plane").value_or(0);
  options.sh_degree_limit = a.at("sh_degree");
  options.low_pass = optional<float>(a, "low_pass");
  if (const auto name = optional<std::string>(a, "anti_aliasing"))
    options.anti_aliasing = *name == "mip" ? math::AntiAliasing::mip_splatting : math::AntiAliasing::classic;
  options.detail_px = optional<float>(a, "detail");
  options.max_gaussians = optional<std::uint64_t>(a, "max_gaussians");
  const std::string pipeline = a.at("pipeline");
  options.pipeline = pipeline == "baseline" ? Pipeline::baseline
                     : pipeline == "paper"  ? Pipeline::paper
                     : pipeline == "turbo"  ? Pipeline::turbo
                                            : Pipeline::automatic;
  return give(a, options);
}

// Draws `cameras` into the pictures from `first` on of the arrays.
Json render(const Json& a) {
  const auto cameras = cameras_of(a);
  const auto first = a.at("first").get<std::size_t>();
  HeldRenderer& held_renderer = *held<RendererHandle>(a, "renderer");
  if (first == 0) held_renderer.stats.clear();
  if (cameras.empty()) return nullptr;
  const std::size_t n_pixels =
      static_cast<std::size_t>(cameras.front().width) * static_cast<std::size_t>(cameras.front().height);
  PictureArrays arrays;
  if (auto* p = address<float>(a, "rgb")) arrays.rgb = p + 3 * n_pixels * first;
  if (auto* p = address<std::uint8_t>(a, "codes")) arrays.codes = p + 3 * n_pixels * first;
  if (auto* p = address<float>(a, "alpha")) arrays.alpha = p + n_pixels * first;
  if (auto* p = address<float>(a, "depth")) arrays.depth = p + n_pixels * first;
  arrays.on_device = a.at("on_device");
  arrays.stream = address<CUstream_st>(a, "stream");
  const auto stats =
      take(held_renderer.renderer.render_all(scene_of(a), cameras, arrays, held<RenderOptions>(a, "options")));
  held_renderer.stats.insert(held_renderer.stats.end(), stats.begin(), stats.end());
  return nullptr;
}

// Waits for `seconds`: true or false as of Renderer::refine(), null if more waiting may help, which it cannot do if it
// is the last.
Json refine(const Json& a) {
  const double seconds = a.at("seconds");
  const auto start = std::chrono::steady_clock::now();
  auto refined = held<RendererHandle>(a, "renderer")
                     ->renderer.refine(scene_of(a), cameras_of(a).front(), seconds, held<RenderOptions>(a, "options"));
  // One that ends early without success has no room for the view. An error at the end is of a read that is retried.
  const std::chrono::duration<double> took = std::chrono::steady_clock::now() - start;
  const bool is_over = took.count() < seconds || a.at("last").get<bool>();
  if (is_over || (refined && *refined)) return take(std::move(refined));
  return nullptr;
}

Json prepare(const Json& a) {
  take(held<RendererHandle>(a, "renderer")->renderer.prepare(scene_of(a)));
  return nullptr;
}

Json frame_stats(const Json& a) {
  Json list = Json::array();
  for (const FrameStats& s : held<RendererHandle>(a, "renderer")->stats) {
    list.push_back({{"total_ms", s.total_ms},
                    {"project_ms", s.project_ms},
                    {"sort_ms", s.sort_ms},
                    {"bin_ms", s.bin_ms},
                    {"blend_ms", s.blend_ms},
                    {"gaussians", s.gaussians},
                    {"pages", s.pages},
                    {"detail_px", s.detail_px},
                    {"visible", s.visible},
                    {"instances", s.instances},
                    {"evaluated", s.evaluated},
                    {"blended", s.blended},
                    {"bytes", s.bytes},
                    {"pages_missing", s.stream.pages_missing},
                    {"detail_reached_px", s.stream.detail_reached_px}});
  }
  return list;
}

// Where a camera sees each Gaussian, by gsplat's definition: FP32 means2d [n, 2], depths [n], conics [n, 3] and
// opacities [n], int32 radii [n, 2]. Of one that is not in the picture only the opacity is written.
Json project(const Json& a) {
  constexpr float kLargestRadius = 2147483520.0F;  // that an int32 holds
  const Scene held_scene = scene_of(a);
  const SceneView scene = take(held_scene.view());
  const RenderOptions options = with_declarations({}, held_scene.declarations());
  const Camera camera = cameras_of(a).front();
  const auto view = view_of<float>(camera, kNoOrigin, a.at("near_plane"), a.at("far_plane"));
  const auto width = static_cast<float>(camera.width), height = static_cast<float>(camera.height);
  auto* const means2d = address<float>(a, "means2d");
  auto* const depths = address<float>(a, "depths");
  auto* const conics = address<float>(a, "conics");
  auto* const opacities = address<float>(a, "opacities");
  auto* const radii = address<std::int32_t>(a, "radii");
  for (std::size_t i = 0; i < scene.n; ++i) {
    const float *m = &scene.mean[3 * i], *r = &scene.rotation[4 * i], *s = &scene.scale[3 * i];
    opacities[i] = scene.opacity[i];
    const auto p = math::project_by_model<float>(view, {m[0], m[1], m[2]}, {r[0], r[1], r[2], r[3]}, {s[0], s[1], s[2]},
                                                 scene.opacity[i], *options.low_pass, *options.anti_aliasing);
    if (!p.footprint.valid) continue;
    const float level = -2 * math::power_cutoff(p.footprint.opacity);
    if (!(level > 0)) continue;
    const float u = p.mean.u + 0.5F, v = p.mean.v + 0.5F;  // gsplat's pixel centres are at the halves
    const float radius_x = std::min(std::ceil(std::sqrt(level * p.footprint.cov.xx)), kLargestRadius);
    const float radius_y = std::min(std::ceil(std::sqrt(level * p.footprint.cov.yy)), kLargestRadius);
    if (u + radius_x <= 0 || u - radius_x >= width || v + radius_y <= 0 || v - radius_y >= height) continue;
    means2d[2 * i] = u, means2d[2 * i + 1] = v;
    depths[i] = p.z;
    conics[3 * i] = p.footprint.conic.a, conics[3 * i + 1] = p.footprint.conic.b;
    conics[3 * i + 2] = p.footprint.conic.c;
    opacities[i] = p.footprint.opacity;
    radii[2 * i] = static_cast<std::int32_t>(radius_x), radii[2 * i + 1] = static_cast<std::int32_t>(radius_y);
  }
  return nullptr;
}

// ---- arrays in GPU memory

Json allocate(const Json& a) {
  DeviceBlock block;
  if (const auto bytes = a.at("bytes").get<std::uint64_t>(); bytes > 0)
    block = take(held<RendererHandle>(a, "renderer")->renderer.allocate_on_device(bytes));
  const auto data = reinterpret_cast<std::uintptr_t>(block.data.get());
  const int device = block.device;
  give(a, std::move(block));
  return {{"address", data}, {"device", device}};
}

// Owned by the capsule's consumer until it calls the deleter.
struct Managed {
  DLManagedTensor tensor{};
  std::vector<std::int64_t> shape;
  DeviceBlock block;
};

void release(DLManagedTensor* tensor) {
  delete static_cast<Managed*>(tensor->manager_ctx);
}

// A capsule that was not consumed; a consumed one is named "used_dltensor".
void release_unused(void* capsule) {
  if (PyCapsule_IsValid(capsule, "dltensor") == 0) return;
  release(static_cast<DLManagedTensor*>(PyCapsule_GetPointer(capsule, "dltensor")));
}

// The addresses of a DLManagedTensor and of its capsule's destructor.
Json dlpack(const Json& a) {
  auto managed = std::make_unique<Managed>();
  managed->shape = a.at("shape").get<std::vector<std::int64_t>>();
  managed->block = held<DeviceBlock>(a, "block");
  DLTensor& t = managed->tensor.dl_tensor;
  t.data = managed->block.data.get();
  t.device = {kDLCUDA, managed->block.device};
  t.ndim = static_cast<int>(managed->shape.size());
  t.dtype = a.at("dtype") == "float32" ? DLDataType{kDLFloat, 32, 1} : DLDataType{kDLUInt, 8, 1};
  t.shape = managed->shape.data();
  managed->tensor.manager_ctx = managed.get();
  managed->tensor.deleter = &release;
  return {reinterpret_cast<std::uintptr_t>(&managed.release()->tensor),
          reinterpret_cast<std::uintptr_t>(&release_unused)};
}

}  // namespace

Calls render_calls() {
  return {{"make_renderer", make_renderer},
          {"make_options", make_options},
          {"render", render},
          {"refine", refine},
          {"prepare", prepare},
          {"frame_stats", frame_stats},
          {"project", project},
          {"allocate", allocate},
          {"dlpack", dlpack}};
}

}  // namespace rgs::python
