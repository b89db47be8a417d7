// plausible_cloud.hpp - seeded clouds with values like trained ones, for lossy codecs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "golden_scenes.hpp"

namespace rgs::test {

/// n Gaussians: most means in a box of 10 units, one in 50 up to a thousand times as far; scales over eight octaves;
/// colours and their coefficients are correlated with neighbours and each other.
inline SplatCloud plausible_cloud(std::uint64_t n, int sh_degree, SplitMix& random) {
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    const float far = random.below(50) == 0 ? std::ldexp(1.f, static_cast<int>(random.below(10))) : 1.f;
    for (float& x : s.mean) x = random.dyadic(-5, 5) * far;
    for (float& x : s.log_scale) x = -4 + random.dyadic(-3, 3);
    for (float& x : s.rotation) x = random.dyadic(-1, 1) + 0x1p-13f;
    s.opacity_logit = random.dyadic(-6, 8);
    for (int k = 0; k < sh_coefficients(sh_degree); ++k) {
      const float size = k == 0 ? 1.5f : 0.3f / static_cast<float>(k);
      const float grey = (k == 0 ? std::sin(s.mean[0]) : random.dyadic(-1, 1)) * size;
      for (int c = 0; c < 3; ++c) s.sh[3 * k + c] = grey + 0.2f * size * random.dyadic(-1, 1);
    }
    cloud.set(i, s);
  }
  return cloud;
}

}  // namespace rgs::test
