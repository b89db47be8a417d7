// check_error.hpp - measures a finished page against its children, as the builder did: does its stated error hold?
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/splat_cloud.hpp"

namespace rgs::lod {

/// An error is refuted if the measured one is more than this times as large. Not 1: see error_against(). The second
/// with Profile::archive, whose losses may exceed what levels change.
inline constexpr float kErrorTolerance = 8, kLossyErrorTolerance = 1000;

/// Footprint, world units, from which on a page may replace its children, by the builder's measure; at most `stated`
/// where it is good enough from twice that on. Which Gaussians merged into which is unknown here, and values are rounded: the
/// page is compared as a whole, and the result is near the builder's, not equal. 0 where nothing was simplified: the
/// children have one Gaussian, or the page looks the same and `may_look_same`. What is_far() is left out. `children`:
/// Gaussians of all children, at least one. Deterministic. Memory: about 1 KiB a Gaussian, and pictures.
float error_against(const SplatView& children, const SplatView& page, float stated, bool may_look_same = true);

}  // namespace rgs::lod
