// first_view.cpp - the camera of rgs-render for a scene without cameras, for the page's tests.
// SPDX-License-Identifier: Apache-2.0
//
// rgs_first_view WIDTH HEIGHT FILE... prints a line of 12 numbers for each file: the camera's centre, then world to camera, row by row.
// A file with levels of detail is streamed.

#include <cstdio>
#include <cstdlib>
#include <utility>

#include "rgs/scene.hpp"
#include "scene_file.hpp"

namespace {

using namespace rgs;

Result<std::pair<SceneBounds, glm::dvec3>> subject_of(const char* path) {
  if (const auto streamed = Scene::open(path, {.pool = *StreamPool::create()}))
    return std::pair(*subject_bounds(*streamed), declared_up(*streamed->declarations()));
  const auto scene = open_scene_file(path);
  if (!scene) return tl::unexpected(scene.error());
  const auto bounds = subject_bounds(scene->scene);
  if (!bounds) return tl::unexpected(bounds.error());
  return std::pair(*bounds, scene->up);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 4) return 2;
  for (int i = 3; i < argc; ++i) {
    const auto subject = subject_of(argv[i]);
    if (!subject) {
      std::fprintf(stderr, "%s: %s\n", argv[i], subject.error().what);
      return 3;
    }
    const Camera camera =
        default_view(subject->first, {.width = std::atoi(argv[1]), .height = std::atoi(argv[2])}, subject->second);
    const glm::dvec3 at = camera_centre(camera);
    std::printf("%.17g %.17g %.17g", at.x, at.y, at.z);
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) std::printf(" %.17g", camera.world_to_camera[column][row]);
    }
    std::printf("\n");
  }
  return 0;
}
