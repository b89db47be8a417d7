// constants.hpp - every threshold of the image's definition, with its reason.
// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace rgs::math {

// Values without further comment are the original 3DGS rasteriser's (Kerbl et al. 2023, reference code): trained scenes
// have adapted to them, so changing one changes every image.

inline constexpr int kTileSize = 16;  ///< pixels along a tile's side; a 3DGS square is listed tile by tile

inline constexpr float kNearPlane = 0.2F;  ///< depth at or below which a Gaussian is not drawn, world units

/// The projection is linearised at most this far outside the image, as a multiple of tan(fov/2): farther out, the
/// Jacobian of a Gaussian beside the camera would smear it over the whole image.
inline constexpr float kFovClamp = 1.3F;

/// px^2 added to the covariance's diagonal, so that no Gaussian is narrower than a pixel
inline constexpr float kLowPass = 0.3F;

/// Floor of (trace/2)^2 - det for the larger eigenvalue, so that rounding leaves its root defined.
inline constexpr float kEigenFloor = 0.1F;

inline constexpr float kSquareSigmas = 3;  ///< half side of the square extent, in standard deviations of the long axis

/// Opacities below a step of an 8-bit channel are skipped, which also bounds a Gaussian: exp(-r^2/2) = 1/255 at 3.33.
inline constexpr float kAlphaMin = 1.0F / 255.0F;
inline constexpr float kLog2AlphaMin = -7.9943534F;  ///< log2(1/255), the same threshold on the folded exponent

inline constexpr float kAlphaMax = 0.99F;  ///< keeps transmittance positive, and catches exponents rounded above 0

/// A pixel stops before the Gaussian that would take its transmittance below this; that one is not blended.
inline constexpr float kTransmittanceMin = 1e-4F;

/// Mip filter: floor of the determinant ratio under the root (3DGS's anti-aliasing mode; 0.005 of opacity).
inline constexpr float kMipRatioMin = 0.000025F;

inline constexpr float kLog2E = 1.44269504F;  ///< log2(e): exponents are in base 2, which hardware evaluates

/// Schraudolph (1999): shift of the exponent's fraction that turns bits into exp. The paper's value minimises the
/// root-mean-square error (-3.12% .. +2.84%, mean +0.83% over [-ln 255, 0]).
inline constexpr float kSigmaPaper = 0.045677F;
inline constexpr float kSigmaZeroMean = 0.0577F;  ///< makes the mean relative error zero (-3.93% .. +1.98%)

}  // namespace rgs::math
