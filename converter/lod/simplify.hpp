// simplify.hpp - replaces a group by fewer Gaussians that look alike from afar, and measures from how far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "gaussians.hpp"

namespace rgs::lod {

struct Simplified {
  Gaussians gaussians;
  /// Footprint, world units, from which on the result may replace the group: the squared difference of its pictures
  /// from supersampled ones of the group is then at most allowed_squared(). Infinite where squares overflow FP32.
  /// docs/develop/LEVELS.md, "Error".
  float error = 0;
};

enum class Quality : std::uint8_t {
  fast,  ///< closed form
  best,  ///< and colours and opacities fitted to pictures
};

class FitDevice;

/// Replaces `group` by at most `n` < group.size() Gaussians. Deterministic. `device`: where `best` fits; null: here.
Simplified simplify(const Gaussians& group, std::size_t n, Quality quality = Quality::fast,
                    FitDevice* device = nullptr);

}  // namespace rgs::lod
