// image_metrics.hpp - how much two pictures differ: squared error, PSNR, the SSIM of 3D Gaussian splatting,
// and FLIP.
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
  double psnr = 0;                ///< -10 log10(mse), dB: the peak is 1; infinity for equal pictures
  float largest = 0;              ///< largest absolute difference of any channel
  std::size_t largest_index = 0;  ///< its index in Image::pixels, the first of several
};

/// Differences of the values themselves, neither clamped to 0..1 nor rounded to 8 bits.
Result<ImageDifference> difference(const Image& a, const Image& b);

/// Structural similarity (Wang et al. 2004) as 3DGS training defines it: Gaussian window of 11x11 pixels with
/// sigma 1.5, pixels beyond the edge taken as 0 in both pictures, C1 = 0.01^2, C2 = 0.03^2, mean over all pixels and
/// channels. 1 for equal pictures, exactly.
Result<double> ssim(const Image& a, const Image& b);

inline constexpr double kPixelsPerDegree = 67.02;  ///< a monitor of 3840 pixels on 0.7 m, seen from 0.7 m
/// Mean of LDR-FLIP (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020) of two sRGB
/// pictures of 3 channels, clamped to 0..1: 0 for equal pictures, exactly, and at most 1. The paper's monitor shows
/// kPixelsPerDegree. `map` takes each pixel's value, [height, width, 1]; may be null. Also bad_argument: other
/// channels, or not 1 to 1000 pixels per degree.
Result<double> flip(const Image& a, const Image& b, double pixels_per_degree = kPixelsPerDegree, Image* map = nullptr);

}  // namespace rgs
