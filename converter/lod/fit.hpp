// fit.hpp - compares pictures of Gaussians with those of a group, and fits their colours.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "gaussians.hpp"
#include "pictures.hpp"

namespace rgs::lod {

/// How levels are drawn: docs/develop/LEVELS.md.
inline constexpr Filter kDrawn{0.1F, true};

/// The supersampled picture of a group in `frame`: drawn at `supersampling` times the size, then averaged.
void true_picture(const Gaussians& gaussians, const Frame& frame, int supersampling, Projection& projection,
                  Picture& fine, Picture& out);

/// Squared difference of two pictures, integrated over pixels and averaged over the three colours and all backgrounds
/// from black to white; and the area that the first covers. In pixels.
struct Difference {
  double squared = 0, covered = 0;
};
Difference difference(const Picture& truth, const Picture& drawn);

/// Draws `gaussians` from many sides, one a step, in pixels of size `pixel` and twice that, and moves opacities and
/// harmonics downhill (Adam) towards the pictures of `group`. Those that cross a picture's edge do not move in that step.
void fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel);

}  // namespace rgs::lod
