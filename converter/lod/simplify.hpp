// simplify.hpp - replaces a group by fewer Gaussians that look alike from afar, and measures from how far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "fit.hpp"
#include "gaussians.hpp"

namespace rgs::lod {

struct Simplified {
  Gaussians gaussians;
  /// Footprint, world units, from which on the result may replace the group: the squared difference of its pictures
  /// from supersampled ones of the group is then at most allowed_squared(). docs/develop/LEVELS.md, "Error".
  float error = 0;
};

inline constexpr double kAllowed = 8;              // 9 dB
inline constexpr double kAllowedSquared = 1e-5;    // 50 dB
inline constexpr double kInexactSquared = 8.6e-5;  // 40.7 dB
inline constexpr double kGrowthOfInexact = 0.4;
/// Squared difference allowed to the replacement of a group whose own unsupersampled picture differs by `of_group` and
/// that covers `covered`: kAllowed times of_group, less the more that exceeds kInexactSquared, so that pages spend
/// Gaussians where they show; at least kAllowedSquared. All three in one unit.
double allowed_squared(double of_group, double covered);

/// Replaces `group` by at most `n` < group.size() Gaussians. Deterministic.
Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options);

}  // namespace rgs::lod
