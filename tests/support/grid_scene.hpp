// grid_scene.hpp - Gaussians on a coarse grid: most depths and many means are shared.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <map>
#include <random>
#include <vector>

#include "renderer_fixture.hpp"

namespace rgs::test {

/// n Gaussians at 17 x 17 x 6 positions before front_camera(), on both sides of 0. Some at one position differ in a
/// single attribute, down to one coefficient of SH degree 3, and some in none.
inline std::vector<Splat> grid_splats(unsigned seed, int n) {
  Random random(seed);
  const auto step = [&random](int below) { return std::floor(random.uniform(0, below)); };
  std::vector<Splat> splats;
  for (int i = 0; i < n; ++i) {
    Splat s = splat_at(0.25 * (step(17) - 8), 0.25 * (step(17) - 8), 2 + 0.5 * step(6), 1, 0.2 * (1 + step(4)));
    for (float& log_scale : s.log_scale) log_scale = static_cast<float>(std::log(0.05 * (1 + step(4))));
    const auto q = cast<float>(random.rotation());
    s.rotation[0] = q.w, s.rotation[1] = q.x, s.rotation[2] = q.y, s.rotation[3] = q.z;
    for (int k = 0; k < 48; ++k) s.sh[k] = static_cast<float>(random.uniform(-1, 1) * (k < 3 ? 1.5 : 0.2));
    splats.push_back(s);
    if (i % 5 != 0) continue;
    switch (static_cast<int>(step(6))) {
      case 0: s.opacity_logit += 1; break;
      case 1: s.log_scale[2] += 0.5F; break;
      case 2: s.sh[1] += 1; break;
      case 3: s.rotation[3] += 0.5F; break;
      case 4: s.sh[47] += 2; break;
      default: break;
    }
    splats.push_back(s);
  }
  return splats;
}

/// Turned so that different positions of the grid have different depths: only equal means tie.
inline Camera turned_camera(int width, int height) {
  Camera camera = front_camera(width, height);
  camera.world_to_camera = from_row_major(rigid({0.98, 0.14, -0.1, 0.1}, {0.1, -0.2, 1.3}));
  return camera;
}

/// The scene without ties: of the Gaussians at one mean, each later one a little farther from the camera, along its ray.
/// Its picture, which no rule for equal depths can change, is the one that drawing them in this order gives.
inline std::vector<Splat> untied(std::vector<Splat> splats, const Camera& camera) {
  const glm::dmat4 to_world = glm::inverse(camera.world_to_camera);
  std::map<std::array<float, 3>, int> n_before;
  for (Splat& s : splats) {
    const double farther = 2e-6 * n_before[{s.mean[0], s.mean[1], s.mean[2]}]++;
    for (int axis = 0; axis < 3; ++axis) {
      const double eye = to_world[3][axis];
      s.mean[axis] = static_cast<float>(eye + (1 + farther) * (static_cast<double>(s.mean[axis]) - eye));
    }
  }
  return splats;
}

inline std::vector<Splat> shuffled(std::vector<Splat> splats, unsigned seed) {
  std::shuffle(splats.begin(), splats.end(), std::mt19937(seed));
  return splats;
}

}  // namespace rgs::test
