// core_box.hpp - where most of what shows of some Gaussians lies: what a page's footprint is measured to.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::lod {

/// Of what shows of Gaussians, at most so much lies before their core on each axis, and as much behind it.
inline constexpr double kOutsideCore = 0.05;

/// Box of the means of Gaussians first .. first + n - 1, n > 0, without the outermost on each axis: what is left out on a side
/// covers at most kOutsideCore of what all cover, each by its opacity and the areas of its sides. Holds at least one mean
/// on each axis.
Box core_of(const SplatView& splats, std::uint64_t first, std::uint64_t n);

}  // namespace rgs::lod
