// audit_distances.hpp - what the levels of detail of a file look like from 1 to 8 times as far, against the truth.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "audit.hpp"
#include "audit_render.hpp"
#include "rgs/camera.hpp"

namespace rgs::audit {

/// Times as far as the views are: by so much their sizes are divided.
inline constexpr std::array<int, 4> kDistances{1, 2, 4, 8};
/// Sides from which on a picture says something of the scene, pixels.
inline constexpr int kLeastSide = 8;

/// Draws the source for the truth and the file at options.asset, which has levels of detail, as each FarScene, in `cameras`.
/// Views are taken in batches whose pictures fit into 512 MB. Memory beside these: source and asset are not held at a
/// time; of the asset the leaves and all pages as FP32.
Outcome<DistanceReport> compare_distances(const RenderInputs& inputs, const Options& options,
                                          std::span<const Camera> cameras, tool::Progress& progress);

}  // namespace rgs::audit
