// footprint.hpp - a pixel's footprint at a page, whether the page is fine enough there, and from which detail on; the
// same bits on host and device. docs/format/FORMAT.md "Error and cut".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <limits>

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

inline constexpr float kDetailStep = 1.2F;  ///< a fifth fewer to a third fewer Gaussians
/// The next coarser detail where the cut of `detail_px` has too many Gaussians.
inline float coarser(float detail_px) {
  constexpr float kFirst = 0.25F, kMost = std::numeric_limits<float>::max();
  const float next = kDetailStep * detail_px;
  return next < kFirst ? kFirst : next > kMost ? kMost : next;
}

/// What a limit of Gaussians chooses from: the detail asked for, then coarser() ones; at the last one any page is fine
/// enough.
inline constexpr int kDetailSteps = 128;
struct DetailSteps {
  float px[kDetailSteps];
};
inline DetailSteps detail_steps(float asked_px) {
  DetailSteps steps{};
  for (float& px : steps.px) px = asked_px, asked_px = coarser(asked_px);
  steps.px[kDetailSteps - 1] = std::numeric_limits<float>::max();
  return steps;
}

/// The finest of `steps` at which a page of this error is_fine_enough(); the last one if none is.
RGS_HD inline int first_fine_step(const DetailSteps& steps, float error, double footprint) {
  int low = 0, high = kDetailSteps - 1;
  while (low < high) {
    const int middle = (low + high) / 2;
    if (is_fine_enough(error, steps.px[middle], footprint)) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  return low;
}

/// The finest step whose cut fits. `changes` [kDetailSteps]: by how many Gaussians each step's cut differs from that of
/// the step before, modulo 2^64. `root_step`: the root's first_fine_step(), which is taken if none fits. `gaussians`:
/// of the cut.
RGS_HD inline int finest_fitting_step(const unsigned long long* changes, int root_step,
                                      unsigned long long max_gaussians, unsigned long long& gaussians) {
  gaussians = changes[0];
  int step = 0;
  while (step < root_step && gaussians > max_gaussians) gaussians += changes[++step];
  return step;
}

}  // namespace rgs::lod
