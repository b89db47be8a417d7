// random_cloud.hpp - seeded clouds with every value that an encoder may meet.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "golden_scenes.hpp"

namespace rgs::test {

/// n valid Gaussians: scales over the whole legal range or a part of it, logits +-30, quaternions of any norm, SH of
/// any size, absent SH, distant outliers, both zeros.
inline SplatCloud random_cloud(std::uint64_t n, int sh_degree, SplitMix& random) {
  SplatCloud cloud;
  cloud.resize(n, sh_degree);
  const int scale_range = static_cast<int>(random.below(60)) + 1;
  const int scale_centre =
      static_cast<int>(random.below(static_cast<std::uint64_t>(2 * (60 - scale_range) + 1))) - (60 - scale_range);
  const std::uint64_t absent = random.below(16);  // SH channels and degrees that are 0
  const int sh_exponent = static_cast<int>(random.below(220)) - 120;
  for (std::uint64_t i = 0; i < n; ++i) {
    Splat s;
    const float far = random.below(50) == 0 ? std::ldexp(1.f, static_cast<int>(random.below(110))) : 1.f;
    for (float& x : s.mean)
      x = random.below(20) == 0 ? (random.below(2) == 0 ? -0.f : 0.f) : random.dyadic(-9, 9) * far;
    for (float& x : s.log_scale) x = static_cast<float>(scale_centre) + random.dyadic(-scale_range, scale_range);
    const float size = std::ldexp(1.f, static_cast<int>(random.below(100)) - 50);
    for (float& x : s.rotation) x = (random.dyadic(-1, 1) + 0x1p-13f) * size;
    s.opacity_logit = random.below(8) == 0 ? (random.below(2) == 0 ? -30.f : 30.f) : random.dyadic(-20, 20);
    for (int k = 0; k < 3 * sh_coefficients(sh_degree); ++k) {
      if ((absent >> sh_degree_of(k / 3) & 1) != 0) continue;
      s.sh[k] = std::ldexp(random.dyadic(-1, 1), sh_exponent);
    }
    cloud.set(i, s);
  }
  if (n != 0 && random.below(2) == 0) {  // the limits themselves
    cloud.log_scale[random.below(3 * n)] = 60.f;
    cloud.log_scale[random.below(3 * n)] = -60.f;
    cloud.sh[random.below(cloud.sh.size())] = 0x1.fbfffep99f;
  }
  return cloud;
}

}  // namespace rgs::test
