// shape_formulas.hpp - docs/format/ARCHIVE.md "Codec 3: from codes to rows", number by number, without branches, so that
// loops vectorise. Logarithms are integers: 1/65536 octaves.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

#include "rgs/archive_formulas.hpp"

namespace rgs::detail {

inline constexpr std::int32_t kOctave = 1 << 16;

/// About log2 of x >= 0: linear between powers of two.
RGS_HD inline std::int32_t octaves_of(double x) {
  return static_cast<std::int32_t>(std::bit_cast<std::int64_t>(x) >> 36) - 1023 * kOctave;
}

/// About 2^octaves, |octaves| at most 2^24.
RGS_HD inline double power_of_octaves(std::int32_t octaves) {
  return static_cast<double>(scale_significand(octaves)) * power_of_two(octaves >> 16);
}

/// Steps are 2^(i / 2), i from kLeastStep to kMostStep, here in 1/65536.
inline constexpr std::int32_t kLeastStep = -24, kMostStep = 7, kMostTurn = 2;  // larger turns than 2^1 are none
RGS_HD inline std::int32_t step_of(std::int32_t i) {
  const std::int32_t half = (i & 1) == 0 ? 65536 : 92682, whole = i >> 1;
  return whole < 0 ? half >> -whole : half << whole;
}
/// The nearest of them to 2^(octaves / 65536), as i.
RGS_HD inline std::int32_t step_index(std::int32_t octaves, std::int32_t most) {
  const std::int32_t i = (octaves + kOctave / 4) >> 15;
  return i < kLeastStep ? kLeastStep : i > most ? most : i;
}

/// Steps fall with importance: what is subtracted from their octaves.
RGS_HD inline std::int32_t finer_by(std::int32_t slope, std::int32_t importance, std::int32_t middle) {
  return static_cast<std::int32_t>((std::int64_t{slope} * (importance - middle)) >> 17);
}

/// log2 of a blurred scale, limited.
RGS_HD inline std::int32_t blurred_octaves(std::int32_t blur, std::int32_t coarse_step, std::int16_t coarse,
                                           std::int32_t fine_step, std::int16_t fine) {
  constexpr std::int64_t kLimit = 1 << 23;
  const std::int64_t octaves = blur + std::int64_t{coarse} * coarse_step + std::int64_t{fine} * fine_step;
  return static_cast<std::int32_t>(std::clamp(octaves, -kLimit, kLimit));
}

/// Of the two largest of three: the area that is seen.
RGS_HD inline std::int32_t area_octaves(const std::int32_t h[3]) {
  return h[0] + h[1] + h[2] - std::min(std::min(h[0], h[1]), h[2]);
}

/// log2 of importance: opacity^2 times the area seen. A level has a quarter of the Gaussians with four times the area, and
/// is drawn where that area looks a quarter as large; another half octave, since they only approximate the scene.
RGS_HD inline std::int32_t importance_of(std::int32_t opacity, const std::int32_t blurred[3], std::int32_t level) {
  return 2 * opacity + area_octaves(blurred) - level * (kOctave / 2 * 5);
}

/// The square of a scale from its blurred logarithm, in units of the square distance; `blur`: 2^(2 blur / 65536). What
/// hides below the blur is an eighth of it.
RGS_HD inline double variance_of(std::int32_t blurred, double blur) {
  const double rest = power_of_octaves(2 * blurred) - blur, least = blur / 64;
  return rest < least ? least : rest;
}

/// How much a small turn around an axis shows, by the variances along the two others; and its logarithm.
RGS_HD inline double turn_sensitivity(double a, double b, double blur) {
  const double d = a - b;
  return d * d / ((a + blur) * (b + blur));
}
RGS_HD inline std::int32_t turn_octaves(double a, double b, double blur) {
  const double d = a - b;
  return octaves_of(d * d) - octaves_of(a + blur) - octaves_of(b + blur);
}

/// From the square of the inverse standard deviation along each axis of the world: sum of rotation^2 / variance.
RGS_HD inline void world_precision(const double q[4], const double variance[3], double blur, double out[3]) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  const double u[3] = {1 / (variance[0] + blur), 1 / (variance[1] + blur), 1 / (variance[2] + blur)};
  for (int k = 0; k < 3; ++k) {
    out[k] = (r[k][0] * r[k][0] * u[0] + r[k][1] * r[k][1] * u[1]) + r[k][2] * r[k][2] * u[2];
  }
}

/// Unit quaternion w x y z from the last three components, w not negative.
RGS_HD inline void quaternion_of(double x, double y, double z, double q[4]) {
  const double s = (x * x + y * y) + z * z, w = std::sqrt((1 - s) * (s < 1 ? 1.0 : 0.0)),
               scale = 1 / std::sqrt(s + w * w);
  q[0] = w * scale, q[1] = x * scale, q[2] = y * scale, q[3] = z * scale;
}

/// A cell of the grid of means on one axis.
struct GridCell {
  std::int32_t octave, cell;  ///< octave 0: within the half width
  bool negative;
};
RGS_HD inline GridCell grid_cell_of(std::uint32_t coordinate, std::uint32_t bits, std::uint32_t cells) {
  const std::int32_t q = static_cast<std::int32_t>(coordinate) - (std::int32_t{1} << (bits - 1)),
                     n = q >= 0 ? q : -1 - q;
  return {n >> cells, n & ((std::int32_t{1} << cells) - 1), q < 0};
}
/// The place `part` (0 to 1) of the way through the cell, in half widths from the centre.
RGS_HD inline double grid_place(const GridCell& at, std::uint32_t cells, double part) {
  const double fraction = (at.cell + part) * power_of_two(-static_cast<std::int32_t>(cells));
  const double t = at.octave > 0 ? (1 + fraction) * power_of_two(at.octave - 1) : fraction;
  return at.negative ? -t : t;
}

inline constexpr std::int32_t kMostRefinement = 12;
/// Bits that place a mean within its cell: as many as make parts as small as the step, at most kMostRefinement.
RGS_HD inline std::int32_t refinement_bits(std::int32_t cell_octaves, std::int32_t step_octaves) {
  const std::int32_t bits = (cell_octaves - step_octaves + kOctave / 2) >> 16;
  return bits < 0 ? 0 : bits > kMostRefinement ? kMostRefinement : bits;
}

}  // namespace rgs::detail
