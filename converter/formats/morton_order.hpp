// morton_order.hpp - Gaussians along a Morton curve.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "rgs/splat_cloud.hpp"

namespace rgs::detail {

/// Indices of sound Gaussians along the curve to the last bit, those of equal keys in the view's order: unlike
/// sort_by_key(), hardly dependent on the order of the source.
std::vector<std::uint32_t> morton_order(const SplatView& splats);

}  // namespace rgs::detail
