// audit_distances.hpp - compares a file's levels of detail with the truth, from 1 to 8 times as far.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "audit.hpp"
#include "audit_render.hpp"
#include "rgs/camera.hpp"

namespace rgs::audit {

/// Multiples of the views' distance, by which their sizes are divided.
inline constexpr std::array<int, 4> kDistances{1, 2, 4, 8};
/// Smallest useful side of a picture, pixels.
inline constexpr int kLeastSide = 8;

/// Draws the source for the truth and the file at options.asset, which has levels of detail, as each FarScene, in
/// `cameras`. Views are taken in batches whose pictures fit into 512 MB. Further memory: the source, or the asset's
/// leaves and all its pages as FP32.
Outcome<DistanceReport> compare_distances(const RenderInputs& inputs, const Options& options,
                                          std::span<const Camera> cameras, tool::Progress& progress);

}  // namespace rgs::audit
