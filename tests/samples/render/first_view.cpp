// first_view.cpp - the camera of rgs-render for a scene without cameras, for the page's tests.
// SPDX-License-Identifier: Apache-2.0
//
// rgs_first_view WIDTH HEIGHT FILE... prints a line of 12 numbers for each file: the camera's centre, then world to camera, row by row.
// A file with levels of detail is streamed.

#include <cstdio>
#include <cstdlib>

#include "rgs/scene.hpp"
#include "rgs/scene_first_view.hpp"
#include "scene_file.hpp"

namespace {

using namespace rgs;

Result<Camera> camera_of(const Scene& scene, const glm::dvec3& up, const ViewFormat& format) {
  const auto view = first_view(scene, up);
  if (!view) return tl::unexpected(view.error());
  return default_view(*view, scene.origin(), format);
}

Result<Camera> camera_of(const char* path, const ViewFormat& format) {
  if (const auto streamed = Scene::open(path, {.pool = *StreamPool::create()}))
    return camera_of(*streamed, declared_up(*streamed->declarations()), format);
  const auto file = open_scene_file(path);
  if (!file) return tl::unexpected(file.error());
  return camera_of(file->scene, file->up, format);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 4) return 2;
  for (int i = 3; i < argc; ++i) {
    const auto camera = camera_of(argv[i], {.width = std::atoi(argv[1]), .height = std::atoi(argv[2])});
    if (!camera) {
      std::fprintf(stderr, "%s: %s\n", argv[i], camera.error().what);
      return 3;
    }
    const glm::dvec3 at = camera_centre(*camera);
    std::printf("%.17g %.17g %.17g", at.x, at.y, at.z);
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) std::printf(" %.17g", camera->world_to_camera[column][row]);
    }
    std::printf("\n");
  }
  return 0;
}
