// audit_distances.hpp - compares a file's levels of detail with the truth, from ever farther away.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "audit.hpp"
#include "audit_render.hpp"
#include "rgs/camera.hpp"

namespace rgs::audit {

/// Multiples of the views' distance that conditions and tables name; views are divided by twice as much again and again
/// until a side has less than kLeastSide pixels, so that the coarsest levels are drawn too.
inline constexpr std::array<int, 4> kDistances{1, 2, 4, 8};
inline constexpr int kLeastSide = 8;

/// Draws the source for the truth and the file at options.asset, which has levels of detail, as each FarScene, in
/// `cameras`. Views are taken in batches whose pictures fit into 512 MB. Further memory: the source, or the asset's
/// leaves and all its pages as FP32.
Outcome<DistanceReport> compare_distances(const RenderInputs& inputs, const Options& options,
                                          std::span<const Camera> cameras, tool::Progress& progress);

}  // namespace rgs::audit
