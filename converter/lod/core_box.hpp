// core_box.hpp - the core of a page, to which its distance is measured.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::lod {

/// At most this share of the covered area lies outside the core at each end of an axis.
inline constexpr double kOutsideCore = 0.05;

/// Box of the means of Gaussians first .. first + n - 1, n > 0, without the outermost on each axis: those cut off at
/// one end cover at most kOutsideCore of the total, each Gaussian counting its opacity times the areas of its sides.
/// Holds at least one mean on each axis.
Box core_of(const SplatView& splats, std::uint64_t first, std::uint64_t n);

}  // namespace rgs::lod
