// rules.hpp - how a program draws Gaussians, as far as pictures show it, and the picture that such rules give.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>

#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/math/constants.hpp"
#include "rgs/scene.hpp"

namespace rgs::judge {

/// The rules of a program. The defaults are the definition (docs/format/RENDERING.md) of a scene that declares nothing.
struct Rules {
  // Of the Gaussians as kept in memory.
  enum class Positions : std::uint8_t {
    exact,
    world,   ///< FP32 in the world, times a matrix in FP32
    half,    ///< FP16 in the world
    camera,  ///< FP16 relative to the camera
  };
  Positions positions = Positions::exact;
  int scale_steps = 0;        ///< of the logarithm, 21 over all of them, from -12 on; 0: exact
  bool half_scales = false;   ///< FP16
  int opacity_steps = 0;      ///< over 0..1; 0: exact
  bool even_opacity = false;  ///< even ones of 255 steps, of halves the one that is a multiple of 4
  int colour_steps = 0;       ///< of the colour without harmonics, over 0..1; 0: exact
  bool rounds_down = false;   ///< to these steps
  float sh_limit = 0;         ///< largest harmonic; 0: none
  int rotation_bits = 0;      ///< of each number of the quaternion; 0: exact

  bool ignores_axes = false;  ///< of the file: the caller draws its Gaussians as stored

  // Of the projection.
  float near_plane = math::kNearPlane;
  float clip = 0;                ///< means farther out than so many half pictures are not drawn; 0: all are
  bool clamps_slope = true;      ///< of the Jacobian, to 0.3 half pictures beyond the edges
  bool centres_picture = false;  ///< ignores the principal point
  enum class Focal : std::uint8_t { both, x, y };
  Focal focal = Focal::both;        ///< one may stand for both
  float low_pass = math::kLowPass;  ///< px^2
  bool compensated = false;         ///< opacity for the low-pass, as Mip-Splatting
  bool loses_last = false;       ///< of the Gaussian farthest from the world's origin, keeps the variance along x alone
  bool half_covariance = false;  ///< FP16 of the covariance in the world
  float least_difference = 0;    ///< px^2, of the covariance's eigenvalues and their mean
  float axis_epsilon = 0;        ///< px^2, added to the longer axis's variance for its direction alone
  bool drops_round = false;      ///< draws no Gaussian whose axes on the picture are those of its pixels
  float most_radius = 0;   ///< px, of each axis at the cut-off; 0: any; -1: the picture's shorter side, at most 1024
  float least_radius = 0;  ///< px: Gaussians whose axes both are shorter at the cut-off are not drawn

  // Of the colour.
  int sh_degree = 3;           ///< higher ones are ignored
  bool clamps_colour = false;  ///< to 0..1 before blending
  int seen_colour_steps = 0;   ///< of the colour with harmonics; 0: exact

  // Of the order.
  enum class Order : std::uint8_t { depth, distance, file };
  Order order = Order::depth;
  bool is_morton = false;  ///< the file's order is the Morton order of the means, of 10 bits an axis
  int sort_bits = 0;       ///< of the key over the range of what is seen; 0: exact
  bool reverses_ties = false;
  bool is_stale = false;  ///< the order of the camera before

  // Of a pixel.
  float cutoff = 0;              ///< sigmas beyond which nothing is drawn; 0: as far as alpha_min
  bool cuts_square = false;      ///< at a box along the axes, not at an ellipse
  bool draws_n_indices = false;  ///< as many corners of the two triangles of each Gaussian as the scene has Gaussians
  bool falls_to_0 = false;       ///< the exponential is shifted and scaled, so that it is 0 at 2 sqrt 2 sigmas
  float alpha_min = math::kAlphaMin, alpha_max = math::kAlphaMax;
  float transmittance_min = math::kTransmittanceMin;  ///< a pixel stops before it; 0: never
  enum class Blend : std::uint8_t {
    exact,
    over,          ///< back to front, 8 bits, colour times opacity clamped to 0..1
    over_clamped,  ///< the same, colour clamped to 0..1
    under,         ///< front to back, 8 bits
    linear,        ///< exact, of linear light
  };
  Blend blend = Blend::exact;
  enum class Transfer : std::uint8_t { none, encoded, decoded };
  Transfer transfer = Transfer::none;  ///< of the sRGB curve, on the finished picture
  std::array<float, 3> background = {0, 0, 0};
};

/// RGB [height, width, 3] of a scene in memory, on all threads; the same bits for any number of them. Rules by default
/// give the bits of the CPU renderer's scalar definition. `before` is the camera drawn last, for an order that is stale.
Image draw(const SceneView& scene, const Camera& camera, const Rules& rules, const Camera& before);
inline Image draw(const SceneView& scene, const Camera& camera, const Rules& rules) {
  return draw(scene, camera, rules, camera);
}

}  // namespace rgs::judge
