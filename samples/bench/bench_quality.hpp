// bench_quality.hpp - how far a mode's pictures are from the baseline's and from photographs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs::bench {

/// Means over pictures unless they say otherwise.
struct Quality {
  double psnr = 0;                   ///< against the baseline, colours as they are; infinite for equal pictures
  double worst_psnr = 0;             ///< of the worst picture
  double ssim = 0;                   ///< against the baseline
  float largest = 0;                 ///< difference of any channel in any picture
  std::optional<double> photo_psnr;  ///< against the photographs, colours clamped to 0..1
  std::optional<double> photo_loss;  ///< the baseline's photo_psnr less this one, dB
};

/// Pictures [n] of a mode, the baseline's [n], and photographs [n] or none; equal cameras in equal order, n > 0.
/// Errors: those of difference(): sizes differ, a colour is not finite.
Result<Quality> compare(std::span<const Image> baseline, std::span<const Image> pictures,
                        std::span<const Image> photos);

/// Where the photograph of a camera is: FOLDER/NAME.ppm, NAME without folder and extension.
std::string photo_path(const std::string& folder, const Camera& camera);

}  // namespace rgs::bench
