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
  /// pictures from the supersampled ones is then at most kAllowed times that of the group drawn as it is, or below
  /// kAllowedSquared where that is next to none. docs/LEVELS.md, "Error".
  float error = 0;
};

inline constexpr double kAllowed = 5;            // 7 dB
inline constexpr double kAllowedSquared = 1e-5;  // 50 dB

/// At most `n` < group.size() Gaussians for those of `group`. Deterministic.
Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options);

}  // namespace rgs::lod
