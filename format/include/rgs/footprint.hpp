// footprint.hpp - what a pixel covers where a page is nearest, and whether the page will do there: for host and device, to
// the bit the same. docs/format/FORMAT.md "Error and cut".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "rgs/hd.hpp"

namespace rgs::lod {

/// World units that a pixel covers where the box `low` [3] to `high` [3] is nearest to `position` [3], but at a distance of at
/// least `z_near`; `focal_px` > 0.
RGS_HD inline double pixel_footprint(const float* low, const float* high, const double* position, double focal_px,
                                     double z_near) {
  double squared = 0;
  for (int k = 0; k < 3; ++k) {
    const double below = static_cast<double>(low[k]) - position[k], above = position[k] - static_cast<double>(high[k]);
    double outside = below < above ? above : below;
    if (outside < 0) outside = 0;
    squared += outside * outside;
  }
  const double distance = std::sqrt(squared);
  return (distance < z_near ? z_near : distance) / focal_px;
}

/// Whether a page of such an error may be drawn for what is below it. Without an error it always may: where the footprint is
/// infinite, a detail of 0 times it is not a number.
RGS_HD inline bool is_fine_enough(float error, float detail_px, double footprint) {
  return error <= 0 || static_cast<double>(error) <= static_cast<double>(detail_px) * footprint;
}

}  // namespace rgs::lod
