// grid_scene.hpp - Gaussians on a coarse grid: most depths and many means are shared.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
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

inline std::vector<Splat> shuffled(std::vector<Splat> splats, unsigned seed) {
  std::shuffle(splats.begin(), splats.end(), std::mt19937(seed));
  return splats;
}

}  // namespace rgs::test
