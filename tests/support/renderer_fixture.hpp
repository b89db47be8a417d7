// renderer_fixture.hpp - seeded scenes, frames and comparisons for the renderer's tests.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <span>
#include <vector>

#include "random_views.hpp"
#include "rgs/renderer.hpp"

namespace rgs::test {

inline Camera front_camera(int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = camera.fy = 0.8 * width;
  camera.cx = width / 2.0, camera.cy = height / 2.0;
  return camera;
}

/// All that is around a camera, in a picture of its size.
inline Camera panorama_of(Camera camera) {
  camera.model = CameraModel::equirectangular;
  camera.fx = camera.width / (2 * std::numbers::pi), camera.fy = camera.height / std::numbers::pi;
  return camera;
}

inline float logit(double opacity) {
  return static_cast<float>(std::log(opacity / (1 - opacity)));
}

inline Splat splat_at(double x, double y, double z, double scale, double opacity, float red = 1) {
  Splat s;
  s.mean[0] = static_cast<float>(x), s.mean[1] = static_cast<float>(y), s.mean[2] = static_cast<float>(z);
  for (float& log_scale : s.log_scale) log_scale = static_cast<float>(std::log(scale));
  s.opacity_logit = logit(opacity);
  s.sh[0] = (red - 0.5F) / 0.28209479F;
  return s;
}

inline SplatCloud cloud_of(std::span<const Splat> splats, int sh_degree = 0) {
  SplatCloud cloud;
  cloud.resize(splats.size(), sh_degree);
  for (std::size_t i = 0; i < splats.size(); ++i) cloud.set(i, splats[i]);
  return cloud;
}

/// Gaussians before, around and behind front_camera(), from points to walls.
inline std::vector<Splat> random_splats(unsigned seed, int n) {
  Random random(seed);
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    const double z = random.uniform(-1, 12);
    Splat s = splat_at(random.uniform(-0.8, 0.8) * z, random.uniform(-0.8, 0.8) * z, z, 1, random.uniform(0.01, 0.995));
    for (float& log_scale : s.log_scale) {
      log_scale = static_cast<float>(std::log(random.log_uniform(0.003, i % 50 == 0 ? 3 : 0.3)));
    }
    const auto q = cast<float>(random.rotation());
    s.rotation[0] = 2 * q.w, s.rotation[1] = 2 * q.x, s.rotation[2] = 2 * q.y, s.rotation[3] = 2 * q.z;
    for (int k = 0; k < 48; ++k) s.sh[k] = static_cast<float>(random.uniform(-1, 1) * (k < 3 ? 1.5 : 0.2));
    splats.push_back(s);
  }
  return splats;
}

inline Scene scene_of(const SplatCloud& cloud) {
  auto scene = Scene::load(cloud);
  REQUIRE(scene);
  return *std::move(scene);
}

inline RenderOptions baseline_options() {
  return {.pipeline = Pipeline::baseline};
}
inline RenderOptions paper_options() {
  return {.pipeline = Pipeline::paper};
}
inline RenderOptions turbo_options() {
  return {.pipeline = Pipeline::turbo};
}

/// Options in one flat list; the defaults are the image's definition on every backend.
struct Arithmetic {
  std::array<float, 3> background = {0, 0, 0};
  float near_plane = math::kNearPlane;
  float far_plane = 0;
  int sh_degree_limit = 3;
  float low_pass = math::kLowPass;
  math::AntiAliasing anti_aliasing = math::AntiAliasing::classic;
  math::Extent extent = math::Extent::ellipse;
  math::DepthOrder depth_order = math::DepthOrder::exact;
  DepthMapping depth_mapping = DepthMapping::linear;
  int depth_bits = 0;
  std::array<float, 2> depth_range = {0.2F, 100};
  math::Exponent exponent = math::Exponent::direct;
  math::Exp exp = math::Exp::exact;

  operator RenderOptions() const {  // NOLINT(google-explicit-constructor): stands for it
    return {.background = background,
            .near_plane = near_plane,
            .far_plane = far_plane,
            .sh_degree_limit = sh_degree_limit,
            .low_pass = low_pass,
            .anti_aliasing = anti_aliasing,
            .pipeline = Pipeline::paper,
            .paper = {.extent = extent,
                      .depth_order = depth_order,
                      .depth_mapping = depth_mapping,
                      .depth_bits = depth_bits,
                      .depth_range = depth_range,
                      .exponent = exponent,
                      .exp = exp}};
  }
};

/// All outputs of one frame.
struct Frame {
  std::vector<float> rgb, alpha, depth;
  std::vector<std::uint32_t> evaluated, blended;
  FrameStats stats;

  static Frame of(const Camera& camera) {
    const auto n = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
    // NaN and a sentinel, so that an unwritten pixel is detected.
    Frame f;
    f.rgb.assign(3 * n, NAN), f.alpha.assign(n, NAN), f.depth.assign(n, NAN);
    f.evaluated.assign(n, 0xDEADBEEF), f.blended.assign(n, 0xDEADBEEF);
    return f;
  }
  RenderTarget target() { return {rgb, alpha, depth, evaluated, blended}; }
};

inline Frame render(const Scene& scene, const Camera& camera, const RenderOptions& options = Arithmetic(),
                    const RendererOptions& how = {}) {
  auto renderer = Renderer::create(how);
  REQUIRE(renderer);
  Frame frame = Frame::of(camera);
  const auto stats = renderer->render(scene, camera, frame.target(), options);
  REQUIRE(stats);
  frame.stats = *stats;
  return frame;
}

inline double largest_difference(std::span<const float> a, std::span<const float> b) {
  REQUIRE(a.size() == b.size());
  double worst = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const double d = std::abs(static_cast<double>(a[i]) - b[i]);
    worst = d <= worst ? worst : d;  // keeps NaN
  }
  return worst;
}

inline double psnr(std::span<const float> a, std::span<const float> b) {
  REQUIRE(a.size() == b.size());
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i)
    sum += (static_cast<double>(a[i]) - b[i]) * (static_cast<double>(a[i]) - b[i]);
  return 10 * std::log10(static_cast<double>(a.size()) / std::max(sum, 1e-30));
}

}  // namespace rgs::test
