// footprint.hpp - a pixel's footprint at a page, and whether the page is fine enough there; the same bits on host and
// device. docs/format/FORMAT.md "Error and cut".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "rgs/hd.hpp"

namespace rgs::lod {

/// World units that a pixel covers at the point of the box `low` [3] to `high` [3] nearest to `position` [3], at a
/// distance of at least `z_near`; `focal_px` > 0.
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

/// Whether a page of this error may be drawn in place of its descendants. Tests an error of 0 first: with an infinite
/// footprint, a detail of 0 gives NaN.
RGS_HD inline bool is_fine_enough(float error, float detail_px, double footprint) {
  return error <= 0 || static_cast<double>(error) <= static_cast<double>(detail_px) * footprint;
}

}  // namespace rgs::lod
