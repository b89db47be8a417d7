// fit.hpp - compares pictures of Gaussians with those of a group, and fits their colours.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

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

/// The steps of fit_colors().
inline constexpr int kFitSteps = 96, kFitDirections = 32;
inline constexpr int kFitStride = 29;        // visits all directions, neighbours far apart in time
inline constexpr int kFitSupersampling = 4;  // of the truth
// Step sizes of the first picture; they fall to a tenth until the last. Ten times as large, they would spoil the many
// Gaussians that are right already.
inline constexpr float kFitLogitStep = 0.006F;
inline constexpr float kFitDcStep = 0.003F;
inline constexpr float kFitShStep = 0.0008F;
inline constexpr float kFitDecay1 = 0.9F, kFitDecay2 = 0.99F;
inline constexpr float kFitLeastLogit = -9.2F, kFitMostLogit = 4.6F;  // opacities of 0.0001 and 0.99
/// Frames of the group, one a direction, in pixels of size `pixel` and twice that in turn.
std::vector<Frame> fit_frames(const Gaussians& group, float pixel);
/// Draws `gaussians` in the frames of `group`, one a step, and moves opacities and harmonics downhill (Adam) towards its
/// pictures. Those that cross a picture's edge do not move in that step.
void fit_colors(const Gaussians& group, Gaussians& gaussians, float pixel);

}  // namespace rgs::lod
