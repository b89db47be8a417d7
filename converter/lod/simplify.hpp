// simplify.hpp - replaces a group by fewer Gaussians that look alike from afar, and measures from how far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <span>

#include "fit.hpp"
#include "gaussians.hpp"

namespace rgs::lod {

struct Simplified {
  Gaussians gaussians;
  /// Footprint, world units, from which on the result may replace the group: the squared difference of its pictures
  /// from supersampled ones of the group is then at most allowed_squared(). docs/develop/LEVELS.md, "Error".
  float error = 0;
};

inline constexpr double kAllowed = 1.3;          // 1.1 dB
inline constexpr double kAllowedSquared = 1e-3;  // 30 dB
/// Squared difference allowed to the replacement of a group whose own unsupersampled picture differs by `of_group` and
/// that covers `covered`. All three in one unit.
inline double allowed_squared(double of_group, double covered) {
  return std::max(kAllowed * of_group, kAllowedSquared * covered);
}

/// Footprint at which `n` Gaussians suffice, world units: twice the pixel at which Gaussians that cover `area` count n,
/// each counting its share of a pixel, at most 1.
float footprint_of(std::span<const float> area, std::size_t n);

/// Replaces `group` by at most `n` < group.size() Gaussians. Deterministic.
Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options);

}  // namespace rgs::lod
