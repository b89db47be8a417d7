// minimal.cpp - renders an .rgs scene to a picture: minimal SCENE.rgs PICTURE.ppm
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <rgs/camera.hpp>
#include <rgs/renderer.hpp>
#include <rgs/scene.hpp>
#include <rgs/scene_first_view.hpp>

int report(const rgs::Error& error) {
  std::fprintf(stderr, "%s: %s\n", rgs::errc_name(error.code), error.what);
  return rgs::exit_code(error.code);
}

int main(int argc, char** argv) {
  if (argc != 3) return std::fprintf(stderr, "usage: minimal SCENE.rgs PICTURE.ppm\n"), 2;

  const auto scene = rgs::Scene::load(std::string(argv[1]));
  if (!scene) return report(scene.error());
  auto renderer = rgs::Renderer::create();
  if (!renderer) return report(renderer.error());

  const auto view = rgs::first_view(*scene);
  if (!view) return report(view.error());
  const auto camera = rgs::default_view(*view, scene->origin(), {.width = 1280, .height = 720});
  rgs::Image image = rgs::Image::make(camera.width, camera.height, 3);
  rgs::RenderTarget target;
  target.rgb = image.pixels;
  const auto stats = renderer->render(*scene, camera, target);
  if (!stats) return report(stats.error());

  std::ofstream file(argv[2], std::ios::binary);
  file << "P6\n" << image.width << ' ' << image.height << "\n255\n";
  for (const float v : image.pixels)
    file.put(static_cast<char>(static_cast<unsigned char>(std::clamp(v, 0.0F, 1.0F) * 255.0F + 0.5F)));
  if (!file.flush()) return report({rgs::Errc::write_failed, rgs::Error::kNone, "the picture cannot be written"});
  std::printf("%llu Gaussians in %.1f ms on %s\n", static_cast<unsigned long long>(scene->size()), stats->total_ms,
              renderer->backend_name());
}
