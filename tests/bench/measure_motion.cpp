// measure_motion.cpp - steadiness of levels of detail while the camera moves: prints the table "Motion" of
// docs/records/LEVELS.md.
// SPDX-License-Identifier: Apache-2.0
//
//   rgs_measure_motion LEVELS.rgs CAMERAS.json [WIDTH [SUPERSAMPLING]]
//
// Starts at the first test camera, WIDTH pixels wide (160): a dolly back to 16 times the distance of its subject, and
// orbits about the subject at that distance and at 4 times, 120 frames each.
#include <cstdio>
#include <cstdlib>
#include <string>
#include <utility>
#include <vector>

#include "levels_motion.hpp"
#include "rgs/camera_file.hpp"

namespace {

using namespace rgs;
using namespace rgs::test;

constexpr int kFrames = 120;

template <class T>
T value_or_stop(Result<T> result) {
  if (!result) {
    std::fprintf(stderr, "rgs_measure_motion: %s\n", result.error().what);
    std::exit(2);
  }
  return *std::move(result);
}

void print(const char* path, const std::string& what, const MotionRow& row, const MotionRow& truth) {
  const bench::Jump jump = bench::largest_jump(row.steps, truth.steps);
  const bench::Change &step = row.whole.step, &second = row.whole.second;
  std::printf(
      "%s, %s: drawn %.3f, %d changes; /255: step mean %.3f, worst 99.9 %% %.1f, second difference %.1f; over the "
      "truth's %.3f; "
      "between two frames %.3f (frame %d), 99.9 %% %.3f (frame %d)\n",
      path, what.c_str(), row.drawn, row.n_changes, 255 * step.mean, 255 * step.worst_p999, 255 * second.worst_p999,
      bench::unsteadiness(row.whole, truth.whole), jump.mean, jump.mean_frame, jump.p999, jump.p999_frame);
  std::fflush(stdout);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: rgs_measure_motion LEVELS.rgs CAMERAS.json [WIDTH [SUPERSAMPLING]]\n");
    return 2;
  }
  const Scene scene = value_or_stop(Scene::load(std::string(argv[1])));
  const auto set = value_or_stop(read_camera_set(argv[2]));
  const int width = argc > 3 ? std::atoi(argv[3]) : 160;
  const int supersampling = argc > 4 ? std::atoi(argv[4]) : 8;
  Camera camera = set.cameras.front();
  for (std::size_t i = set.cameras.size(); i-- > 0;)
    if (set.split[i] == Split::test) camera = set.cameras[i];
  camera = resized(camera, width, width * camera.height / camera.width);

  auto renderer = value_or_stop(Renderer::create({Backend::cpu}));
  std::vector<float> depth(static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height));
  value_or_stop(renderer.render(scene, camera, {.depth = depth}));
  const double distance = bench::look_at_distance(depth);
  std::printf("%d x %d pixels, subject %.3g away\n", camera.width, camera.height, distance);

  LevelsMotion motion(scene, supersampling);
  const std::vector<Camera> back = bench::dolly(camera, distance, 16, kFrames);
  const Camera far = bench::dolly(camera, distance, 4, 2).back();
  const std::pair<const char*, std::vector<Camera>> paths[] = {
      {"dolly 1x to 16x", back},
      {"orbit at 1x", bench::turntable(camera, distance, 0.25, kFrames)},
      {"orbit at 4x", bench::turntable(far, 4 * distance, 0.25, kFrames)}};
  for (const auto& [name, path] : paths) {
    const MotionRow truth = value_or_stop(motion.truth(path));
    print(name, "truth", truth, truth);
    print(name, "all compensated", value_or_stop(motion.leaves(path)), truth);
    for (const float detail : {0.5F, 1.0F, 2.0F, 4.0F})
      print(name, "detail " + std::to_string(detail).substr(0, 3), value_or_stop(motion.levels(path, detail)), truth);
  }
  return 0;
}
