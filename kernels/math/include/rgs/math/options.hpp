// options.hpp - choices in the image's definition, each a step of the method that can be switched on its own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/layout.hpp"
#include "rgs/math/constants.hpp"

namespace rgs::math {

/// Which tiles list a Gaussian, hence which pixels see it.
enum class Extent : std::uint8_t {
  square,   ///< tiles touched by the square of half side ceil(3 sigma_max) around the mean: the original 3DGS
  ellipse,  ///< tiles with a pixel that reaches alpha >= 1/255: Speedy-Splat (Hanson et al. 2025), exact per tile row
};

enum class AntiAliasing : std::uint8_t {
  classic,        ///< low-pass added, opacity kept: small Gaussians get brighter
  mip_splatting,  ///< opacity times sqrt(det before / det after): the 2D Mip filter (Yu et al. 2024)
};

enum class DepthOrder : std::uint8_t {
  exact,      ///< FP32 depth; equal depths in the order of the scene
  quantized,  ///< b_d bits of depth; Gaussians of one bin in the order of the scene
};

/// Bins of equal depth (linear, the paper) or of equal depth ratio (logarithmic); declared in .rgs files.
using rgs::DepthMapping;

/// How a camera maps camera points to its image; docs/format/RENDERING.md, "Camera models".
enum class CameraModel : std::uint8_t {
  pinhole,
  opencv,           ///< a pinhole with OpenCV's radial and tangential distortion
  opencv_fisheye,   ///< the radius on the image is a polynomial of the angle to the axis (Kannala and Brandt 2006)
  equirectangular,  ///< longitude and latitude; the latitude is from the plane of x and z
  orthographic,     ///< x and y
};
inline constexpr int kDistortions = 8;  ///< coefficients, in OpenCV's and COLMAP's order; those without use are 0

/// How the exponent of a pair is evaluated.
enum class Exponent : std::uint8_t {
  direct,  ///< from the offsets to the mean; opacity multiplies the exponential
  folded,  ///< from six coefficients per tile in tile-local pixels, log(opacity) included
};

enum class Exp : std::uint8_t {
  exact,      ///< the library's
  paper,      ///< bit construction, sigma = 0.045677
  zero_mean,  ///< bit construction, sigma = 0.0577
};

}  // namespace rgs::math
