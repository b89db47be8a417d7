// simplify.hpp - fewer Gaussians that look like a group from afar, and from how far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "fit.hpp"
#include "gaussians.hpp"

namespace rgs::lod {

struct Simplified {
  Gaussians gaussians;
  /// Footprint of a pixel, world units, from which on they may be drawn for the group: the squared difference of their
  /// pictures from the supersampled ones is then at most allowed_squared(). docs/develop/LEVELS.md, "Error".
  float error = 0;
};

inline constexpr double kAllowed = 8;              // 9 dB
inline constexpr double kAllowedSquared = 1e-5;    // 50 dB
inline constexpr double kInexactSquared = 8.6e-5;  // 40.7 dB
inline constexpr double kGrowthOfInexact = 0.4;
/// Squared difference that a picture of a group may have whose own, drawn as it is, is `of_group`, where `covered` is covered: kAllowed
/// times that, the less the worse than kInexactSquared it is itself, so that pages spend Gaussians where they show; at least
/// kAllowedSquared. All three in one unit.
double allowed_squared(double of_group, double covered);

/// At most `n` < group.size() Gaussians for those of `group`. Deterministic.
Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options);

}  // namespace rgs::lod
