// image_metrics.hpp - how much two pictures differ: squared error, PSNR, the SSIM of 3D Gaussian splatting,
// MS-SSIM, GMSD and FLIP.
// SPDX-License-Identifier: Apache-2.0
//
// All functions take pictures of equal size, use all cores, and return the same bits for any number of threads.
// Errors: bad_argument (sizes or channels differ, no pixels, an array that does not match its size), bad_value (a value
// is not finite; Error::offset is its index in the pixel array).
#pragma once

#include <cstddef>

#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace RGS_API rgs {

struct ImageDifference {
  double mse = 0;                 ///< mean of the squared differences over all pixels and channels
  double psnr = 0;                ///< psnr_of(mse)
  float largest = 0;              ///< largest absolute difference of any channel
  std::size_t largest_index = 0;  ///< its index in Image::pixels, the first of several
};

/// -10 log10(mse), dB: the peak is 1; infinity for equal pictures.
double psnr_of(double mse);

/// Differences of the values themselves, neither clamped to 0..1 nor rounded to 8 bits.
Result<ImageDifference> difference(const Image& a, const Image& b);

/// Structural similarity (Wang et al. 2004) as 3DGS training defines it: Gaussian window of 11x11 pixels with
/// sigma 1.5, pixels beyond the edge taken as 0 in both pictures, C1 = 0.01^2, C2 = 0.03^2, mean over all pixels and
/// channels. 1 for equal pictures, exactly.
Result<double> ssim(const Image& a, const Image& b);

/// Multi-scale structural similarity (Wang, Simoncelli, Bovik, "Multiscale structural similarity for image quality
/// assessment", 2003), with the window and constants of ssim(): contrast and structure at five scales, each half as
/// large, and luminance at the coarsest, to the powers 0.0448, 0.2856, 0.3001, 0.2363 and 0.1333. As in the authors'
/// program only windows that lie in the picture count. Mean over the channels; a scale's negative mean counts as 0.
/// Below 161 pixels a side, scales with a side shorter than the window are left out, and the other powers scaled to sum
/// to 1. 1 for equal pictures, exactly. `map` takes 1 less the product of the scales' means over channels at each pixel,
/// [height, width, 1], where windows that do not lie in the picture count as 1; may be null. Also bad_argument: a side
/// below 11 pixels.
Result<double> ms_ssim(const Image& a, const Image& b, Image* map = nullptr);

/// Gradient magnitude similarity deviation (Xue, Zhang, Mou, Bovik, "Gradient Magnitude Similarity Deviation", 2014) of
/// the luma (BT.601) of two pictures of 1 or 3 channels, at half the size, by Prewitt's filter, with c = 170 for luma
/// of 0 to 255: 0 for equal pictures, exactly, and for all of up to 2x2 pixels; larger the less alike they are. As in
/// the paper, the squared deviations are divided by the number of pixels (in the authors' program by one less). `map`
/// takes 1 less the similarity at half the size, [(height + 1) / 2, (width + 1) / 2, 1]; may be null. Also
/// bad_argument: other channels.
Result<double> gmsd(const Image& a, const Image& b, Image* map = nullptr);

inline constexpr double kPixelsPerDegree = 67.02;  ///< a monitor of 3840 pixels on 0.7 m, seen from 0.7 m
/// Mean of LDR-FLIP (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020) of two sRGB
/// pictures of 3 channels, clamped to 0..1: 0 for equal pictures, exactly, and at most 1. The paper's monitor shows
/// kPixelsPerDegree. `map` takes each pixel's value, [height, width, 1]; may be null. Also bad_argument: other
/// channels, or not 1 to 1000 pixels per degree.
Result<double> flip(const Image& a, const Image& b, double pixels_per_degree = kPixelsPerDegree, Image* map = nullptr);

}  // namespace rgs
