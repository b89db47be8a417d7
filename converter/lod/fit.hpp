// fit.hpp - optimises Gaussians until their pictures match those of a group.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "gaussians.hpp"
#include "pictures.hpp"

namespace rgs::lod {

/// How levels are drawn: docs/develop/LEVELS.md.
inline constexpr Filter kDrawn{0.1F, true};
inline constexpr int kSupersampling = 4;  ///< of the truth

struct FitOptions {
  int n_steps = 12;
  int n_directions = 6;   ///< directions of the pictures, one a step
  int supersampling = 2;  ///< of the target pictures
  /// Of the pictures that measure the error: with a factor of two it is within 4% of that with four.
  int n_error_directions = 3, error_supersampling = 2;
  int n_color_steps = 0;  ///< of fit_colors()
};

/// The supersampled picture of a group in `frame`: drawn at `supersampling` times the size, then averaged.
void true_picture(const Gaussians& gaussians, const Frame& frame, int supersampling, Projection& projection,
                  Picture& fine, Picture& out);

/// Squared difference of two pictures, integrated over pixels and averaged over the three colours and all backgrounds
/// from black to white; and the area that the first covers. In pixels.
struct Difference {
  double squared = 0, covered = 0;
};
Difference difference(const Picture& truth, const Picture& drawn);

/// Draws `gaussians` from many sides, one a step, and moves them downhill (Adam) towards the pictures of `group` in
/// pixels of size `pixel`. Those that cross a picture's edge do not move in that step.
void fit(const Gaussians& group, Gaussians& gaussians, float pixel, const FitOptions& options);

/// The same for opacities and harmonics alone, in small steps, at `pixel` and twice that.
void fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel, const FitOptions& options);

}  // namespace rgs::lod
