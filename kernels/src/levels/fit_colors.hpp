// fit_colors.hpp - launches that fit the colours of a page of levels to pictures of the group that it replaces.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Places of the values of a Gaussian, each an array; harmonics follow from kFitSh, coefficients before channels.
enum FitValue : int { kFitMean = 0, kFitScale = 3, kFitRotation = 6, kFitOpacity = 10, kFitSh = 11 };

/// n Gaussians: arrays [stride] of 11 parameters and 3 (degree + 1)^2 harmonics. Scales and opacity are activated.
struct FitGaussians {
  float* values;
  std::uint32_t n, stride;
  int sh_degree;
};

/// A picture from far away: orthonormal axes, corner and side of a pixel in world units.
struct FitFrame {
  float right[3], down[3], forward[3];
  float left, top, pixel;
  std::int32_t width, height;
  std::uint64_t first_pixel;  ///< of its picture among all
};

/// A projected Gaussian: log2 of its falloff is aa dx^2 + ab dx dy + cc dy^2.
struct FitDot {
  float u, v, aa, ab, cc, opacity, color[3];
};
struct alignas(8) FitBox {  ///< pixels; empty if it does not show
  std::int16_t x0, x1, y0, y1;
};
/// Dots front to back, [n].
struct FitDots {
  FitDot* dots;
  FitBox* boxes;
};

/// How opacity and colours move: Adam (Kingma and Ba 2015).
struct FitRules {
  int steps, stride;                   ///< step i draws frame i * stride % n_frames
  float low_pass;                      ///< px^2, opacity compensated
  float logit_step, dc_step, sh_step;  ///< of the first step; they fall to a tenth
  float decay1, decay2;
  float least_logit, most_logit;
};
/// What moves; arrays [stride] of the Gaussians.
struct FitState {
  float* logits;
  float *means, *squares;  ///< moments of the opacity's logit and of each harmonic; 0 before the first step
  std::uint64_t* slopes;   ///< of log opacity, r, g, b in units of 2^-32, signed; 0 before the first step
};

/// For each frame and Gaussian its frame and depth, and its number: keys and items [n_frames * n].
Status launch_fit_keys(const FitGaussians& gaussians, const FitFrame* frames, std::uint32_t n_frames,
                       std::uint64_t* keys, std::uint32_t* items, Stream stream);
/// Projects the sorted items of frames whose pixels are smaller by `factor`.
Status launch_fit_dots(const FitGaussians& gaussians, const FitFrame* frames, std::uint32_t n_frames, int factor,
                       float low_pass, const std::uint32_t* items, const FitDots& dots, Stream stream);
/// Draws each frame's n dots in pixels smaller by `factor`, at most 4, and averages: premultiplied r, g, b and transmittance.
/// `most_tiles`: fit_tiles() of the largest frame in these pixels.
Status launch_fit_truths(const FitFrame* frames, std::uint32_t n_frames, std::uint32_t n, int factor,
                         std::uint32_t most_tiles, const FitDots& dots, float4* pictures, Stream stream);
constexpr std::uint32_t fit_tiles(int width, int height) {
  return static_cast<std::uint32_t>((width + 7) / 8 * ((height + 3) / 4));
}
/// ranks[frame * n + item] = the item's place among those of its frame.
Status launch_fit_ranks(const std::uint32_t* items, std::uint32_t n, std::uint32_t n_frames, std::uint32_t* ranks,
                        Stream stream);

/// The pictures of a fit, and the Gaussians in the order of each, [n_frames * n].
struct FitViews {
  const FitFrame* frames;
  std::uint32_t n_frames, most_pixels;  ///< most_pixels: of a frame
  const float4* pictures;
  const std::uint32_t *items, *ranks;
};
/// All steps, in one launch: each draws a frame and moves opacities and harmonics by how the squared difference from its
/// picture depends on them. `dots`: [n] for each of two steps. Gaussians that cross a frame's edge count as without slope.
Status launch_fit_steps(const FitViews& views, const FitGaussians& gaussians, const FitRules& rules,
                        const FitState& state, const FitDots (&dots)[2], Stream stream);

}  // namespace rgs::cuda
