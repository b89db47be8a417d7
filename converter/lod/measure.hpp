// measure.hpp - how far a replacement's pictures are from its group's, and the footprint from which on that is little.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <span>

#include "gaussians.hpp"

namespace rgs::lod {

inline constexpr double kAllowed = 1.3;          // 1.1 dB
inline constexpr double kAllowedSquared = 1e-3;  // 30 dB
/// Squared difference allowed to the replacement of a group whose own unsupersampled picture differs by `of_group` and
/// that covers `covered`. All three in one unit.
inline double allowed_squared(double of_group, double covered) {
  return std::max(kAllowed * of_group, kAllowedSquared * covered);
}

/// Footprint at which `n` of these Gaussians suffice, by what each covers (areas()): some times the pixel at which they
/// count n, each counting its share of a pixel, at most 1.
float footprint_of(std::span<const float> area, std::size_t n);

inline constexpr int kFootprints = 3;  ///< at which pictures are compared, each twice the one before

/// Squared differences from the supersampled pictures of a group at footprints pixel * 2^k, world units squared.
struct Measured {
  double of_group[kFootprints] = {}, of_result[kFootprints] = {}, covered[kFootprints] = {};
};

/// Adds the differences of one piece; `least_pixel` is the finest pixel that suits it. Pictures hold the means of
/// `framed`.
void measure(const Gaussians& framed, const Gaussians& group, const Gaussians& result, float pixel, float least_pixel,
             Measured& out);

/// The first of the footprints from which on the result is good enough by allowed_squared(); kFootprints: none is.
int first_good(const Measured& measured);
/// Smallest footprint at which the result is good enough; interpolates linearly in logarithms, and extrapolates.
float error_of(const Measured& measured, float pixel);

}  // namespace rgs::lod
