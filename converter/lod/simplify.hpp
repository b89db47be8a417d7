// simplify.hpp - replaces a group by fewer Gaussians that look alike from afar, and measures from how far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "fit.hpp"
#include "gaussians.hpp"
#include "measure.hpp"

namespace rgs::lod {

struct Simplified {
  Gaussians gaussians;
  /// Footprint, world units, from which on the result may replace the group: the squared difference of its pictures
  /// from supersampled ones of the group is then at most allowed_squared(). Infinite where squares overflow FP32.
  /// docs/develop/LEVELS.md, "Error".
  float error = 0;
};

/// Replaces `group` by at most `n` < group.size() Gaussians. Deterministic.
Simplified simplify(const Gaussians& group, std::size_t n, const FitOptions& options);

}  // namespace rgs::lod
