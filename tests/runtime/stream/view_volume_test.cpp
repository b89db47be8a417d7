// view_volume_test.cpp - culling by a view's volume never drops a Gaussian that changes a pixel.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "pages/view_volume.hpp"
#include "render_options.hpp"
#include "rgs/math/covariance.hpp"
#include "rgs/quantize.hpp"
#include "streamed_fixture.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

/// Mean and three standard deviations along each axis: the tightest box of a page.
Box box_of(const Splat& s) {
  float r[9];
  const double norm = std::hypot(std::hypot(s.rotation[0], s.rotation[1]), std::hypot(s.rotation[2], s.rotation[3]));
  const auto unit = [&](int k) { return static_cast<float>(static_cast<double>(s.rotation[k]) / norm); };
  math::rotation_matrix<float>({unit(0), unit(1), unit(2), unit(3)}, r);
  Box box;
  for (std::size_t k = 0; k < 3; ++k) {
    double variance = 0;
    for (std::size_t j = 0; j < 3; ++j) {
      const double along = static_cast<double>(r[3 * k + j]) * std::exp(static_cast<double>(s.log_scale[j]));
      variance += along * along;
    }
    const double reach = 3 * std::sqrt(variance);
    box.min[k] = static_cast<float>(static_cast<double>(s.mean[k]) - reach);
    box.max[k] = static_cast<float>(static_cast<double>(s.mean[k]) + reach);
  }
  return box;
}

}  // namespace

TEST_CASE("a Gaussian whose box is culled changes no pixel, whatever its position and shape") {
  Random random(4242);
  Renderer renderer = cpu_renderer(1);
  int n_shown = 0, n_culled = 0, n_beside = 0;
  for (int i = 0; i < 12000; ++i) {
    CAPTURE(i);
    Camera camera = front_camera(24, 16);
    camera.fx = camera.fy = random.log_uniform(4, 200);
    if (i % 5 == 0) camera.cx = random.uniform(-30, 50), camera.cy = random.uniform(-30, 40);
    // A few standard deviations beside the image, at any depth; round ones where they just reach it.
    const bool is_round = i % 2 == 0;
    const double z = i % 3 == 0 ? random.uniform(0.1, 0.6) : random.log_uniform(0.2, 50);
    const double large = random.log_uniform(0.01, 3) * z;
    double x = (random.uniform(-1.6, 2.6) * 24 - camera.cx) / camera.fx * z;
    const double y = (random.uniform(-1.6, 2.6) * 16 - camera.cy) / camera.fy * z;
    if (is_round) {
      const double right = (24 - camera.cx) / camera.fx;
      x = right * z + random.uniform(0.9, 1.5) * 3 * large * std::hypot(1, right);
    }
    const double u = camera.fx * x / z + camera.cx, v = camera.fy * y / z + camera.cy;
    Splat s = splat_at(x, y, z, 1, 0.999);
    for (float& log_scale : s.log_scale)
      log_scale = static_cast<float>(std::log(large * (is_round ? 1 : random.log_uniform(1e-3, 1))));
    const auto q = cast<float>(random.rotation());
    s.rotation[0] = q.w, s.rotation[1] = q.x, s.rotation[2] = q.y, s.rotation[3] = q.z;
    const bool is_mip = i % 8 < 3;
    const Arithmetic how{.low_pass = is_mip ? 0.1F : 0.3F};
    const Scene scene = scene_of(cloud_of(std::span(&s, 1)));
    const Frame frame = draw(renderer, scene, camera, how);
    const bool shows = std::ranges::any_of(frame.alpha, [](float alpha) { return alpha > 0; });
    const auto settings = detail::resolve(how, std::nullopt, Backend::cpu);
    REQUIRE(settings);
    const pages::ViewVolume volume(detail::make_view(camera, kNoOrigin, *settings), settings->low_pass);
    const bool may = volume.may_show(box_of(s));
    if (shows) CHECK(may);
    n_shown += shows, n_culled += !may, n_beside += shows && (u < 0 || u > 24 || v < 0 || v > 16);
    // A larger box is not culled either.
    if (may) {
      Box larger = box_of(s);
      for (std::size_t k = 0; k < 3; ++k) {
        larger.min[k] -= static_cast<float>(random.uniform(0, 5));
        larger.max[k] += static_cast<float>(random.uniform(0, 5));
      }
      CHECK(volume.may_show(larger));
    }
  }
  MESSAGE(n_shown, " shown, ", n_beside, " with means beside the image; ", n_culled, " culled");
  CHECK(n_beside > 500);
  CHECK(n_culled > 500);
}

TEST_CASE("boxes behind the camera, before the near plane and behind the far plane are culled, and others are not") {
  Camera camera = front_camera(100, 100);
  const auto settings = detail::resolve({.near_plane = 1, .far_plane = 50}, std::nullopt, Backend::cpu);
  REQUIRE(settings);
  const pages::ViewVolume volume(detail::make_view(camera, kNoOrigin, *settings), settings->low_pass);
  const auto at = [](float x, float y, float z, float half) {
    return Box{{x - half, y - half, z - half}, {x + half, y + half, z + half}};
  };
  CHECK(volume.may_show(at(0, 0, 10, 1)));
  CHECK(volume.may_show(at(0, 0, 0, 100)));  // the camera is inside it
  CHECK(!volume.may_show(at(0, 0, -10, 1)));
  CHECK(!volume.may_show(at(0, 0, 0.5F, 0.4F)));
  CHECK(volume.may_show(at(0, 0, 0.5F, 0.6F)));
  CHECK(!volume.may_show(at(0, 0, 60, 1)));
  CHECK(volume.may_show(at(0, 0, 50.5F, 1)));
  CHECK(!volume.may_show(at(40, 0, 10, 1)));
  CHECK(!volume.may_show(at(0, -40, 10, 1)));
  camera.model = CameraModel::opencv_fisheye;  // its volume is not a pinhole's: everything may show
  CHECK(pages::ViewVolume(detail::make_view(camera, kNoOrigin, *settings), settings->low_pass)
            .may_show(at(0, 0, -10, 1)));
}
