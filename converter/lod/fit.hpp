// fit.hpp - Gaussians moved, turned, sized and coloured until their pictures are those of a group.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "gaussians.hpp"
#include "pictures.hpp"

namespace rgs::lod {

/// How levels are drawn: docs/develop/LEVELS.md.
inline constexpr Filter kDrawn{0.1F, true};
inline constexpr int kSupersampling = 4;  ///< of what counts as the truth

struct FitOptions {
  int n_steps = 12;
  int n_directions = 6;   ///< from which pictures are compared, one a step
  int supersampling = 2;  ///< of the pictures that are aimed at
  /// Of the pictures by which the error is measured: at twice the size it is within 4% of that at four times.
  int n_error_directions = 3, error_supersampling = 2;
  int n_color_steps = 0;  ///< of fit_colors()
};

/// What a group looks like through `frame`: drawn at so many times the size, and averaged.
void true_picture(const Gaussians& gaussians, const Frame& frame, int supersampling, Projection& projection,
                  Picture& fine, Picture& out);

/// Integral over pixels of the squared difference of two pictures, the mean over the three colours and over all backgrounds
/// from black to white; and what the first covers. In pixels.
struct Difference {
  double squared = 0, covered = 0;
};
Difference difference(const Picture& truth, const Picture& drawn);

/// Draws `gaussians` from many sides, one a step, and moves them downhill (Adam) towards what `group` looks like
/// in pixels of `pixel`. Those that reach beyond a picture's edge stay as they are there.
void fit(const Gaussians& group, Gaussians& gaussians, float pixel, const FitOptions& options);

/// The same for opacities and harmonics alone, in small steps, in pixels of `pixel` and of twice that.
void fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel, const FitOptions& options);

}  // namespace rgs::lod
