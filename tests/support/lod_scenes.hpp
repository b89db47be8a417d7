// lod_scenes.hpp - generated groups of Gaussians for the tests of levels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>

#include "golden_scenes.hpp"

namespace rgs::test {

/// A wall of side x side small Gaussians in the plane z = 0, one unit wide, in row order. Bricks of 8 x 4 share a
/// colour; every fourth Gaussian is hidden behind the wall.
inline SplatCloud wall(std::uint64_t side, int sh_degree, SplitMix& random) {
  SplatCloud cloud;
  cloud.resize(side * side, sh_degree);
  const float step = 1 / static_cast<float>(side);
  for (std::uint64_t i = 0; i < side * side; ++i) {
    const std::uint64_t x = i % side, y = i / side;
    Splat s;
    s.mean[0] = (static_cast<float>(x) + 0.3F * random.dyadic(-1, 1)) * step;
    s.mean[1] = (static_cast<float>(y) + 0.3F * random.dyadic(-1, 1)) * step;
    s.mean[2] = (i % 4 == 3 ? 2 : 0) * step;
    for (int k = 0; k < 3; ++k) s.log_scale[k] = std::log(step * (k == 2 ? 0.1F : 0.8F));
    s.opacity_logit = 2 + random.dyadic(-1, 1);
    const std::uint64_t brick = (x / 8 * 7919 + y / 4 * 104729) % 5;
    for (int c = 0; c < 3; ++c) s.sh[c] = -1 + 0.5F * static_cast<float>((brick + static_cast<std::uint64_t>(c)) % 5);
    for (int k = 3; k < 3 * sh_coefficients(sh_degree); ++k) s.sh[k] = 0.05F * random.dyadic(-1, 1);
    cloud.set(i, s);
  }
  return cloud;
}

}  // namespace rgs::test
