// activate.hpp - from the parameters of training to what is drawn.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "rgs/quantize.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

inline constexpr const char* kNotDrawable =
    "a Gaussian is damaged (NaN, or an infinity other than an opacity): convert with a repair policy first";

inline bool all_finite(const float* values, std::uint64_t n) {
  return std::all_of(values, values + n, [](float v) { return std::isfinite(v); });
}

/// Of the parameters of training. Infinite logits are opacities of 1 and 0, and a log-scale of -inf is a scale of 0.
inline bool is_drawable(const SplatView& s, std::uint64_t i, std::uint64_t floats) {
  const auto scaled = [](float log_scale) { return log_scale < std::numeric_limits<float>::infinity(); };
  return all_finite(&s.mean[3 * i], 3) && std::all_of(&s.log_scale[3 * i], &s.log_scale[3 * i] + 3, scaled) &&
         all_finite(&s.rotation[4 * i], 4) && !std::isnan(s.opacity_logit[i]) && all_finite(&s.sh[floats * i], floats);
}

/// A zero quaternion becomes the identity.
inline void normalize_rotation(float* q) {
  const float length = std::hypot(std::hypot(q[0], q[1]), std::hypot(q[2], q[3]));
  if (length > 0 && std::isfinite(length)) {
    for (int k = 0; k < 4; ++k) q[k] /= length;
  } else {
    q[0] = 1, q[1] = q[2] = q[3] = 0;
  }
}

/// Gaussian i, in place: log_scale then holds scales, opacity_logit opacities.
inline void activate(SplatCloud& s, std::uint64_t i) {
  for (std::uint64_t k = 3 * i; k < 3 * i + 3; ++k) s.log_scale[k] = scale_from_log(s.log_scale[k]);
  normalize_rotation(&s.rotation[4 * i]);
  s.opacity_logit[i] = opacity_from_logit(s.opacity_logit[i]);
}

}  // namespace rgs::detail
