// audit_picture.hpp - the pictures of a report: difference maps, worst regions, and encoding within a size.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "audit.hpp"
#include "rgs/image.hpp"
#include "rgs/image_metrics.hpp"

namespace rgs::audit {

/// Colour of a difference map for a share 0..1 of its scale: black, violet, red, orange, yellow; above 1 white.
struct Colour {
  float r = 0, g = 0, b = 0;
};
Colour heat(float share);

/// A picture over black, [height, width, 3], and its alpha, [height, width].
Picture over_backgrounds(Image black, std::span<const float> alpha);
/// As Score has them. Errors: those of rgs::difference() and rgs::ssim().
Result<ImageDifference> difference(const Picture& a, const Picture& b);
Result<double> ssim(const Picture& a, const Picture& b);
/// That of kMeasures[which], over the background where it is worse, and its map if not null.
Result<double> measure(std::size_t which, const Picture& a, const Picture& b, Image* map = nullptr);
/// Score::depth; absent if no pixel can be compared, or without depths.
std::optional<DepthScore> depth_difference(const Picture& source, const Picture& asset);
/// Score::over_white.
bool shows_more_over_white(const Picture& a, const Picture& b);

/// Largest absolute difference of each pixel's channels, [height, width, 1], in 8-bit levels, over both backgrounds;
/// values are clamped to 0..1 first, as on a screen.
Image difference_levels(const Picture& a, const Picture& b);
/// Top of the scale of all maps of a report: a round number of levels that at most one pixel in a thousand exceeds.
float scale_top(std::span<const Image> levels);
/// Colours levels by heat() on a scale from 0 to `top`.
Image heat_map(const Image& levels, float top);

/// Shrinks to at most `width` pixels. Averages colours, but keeps the largest of difference levels, so that a single
/// bad pixel stays visible.
Image shrunk(const Image& image, int width);
Image shrunk_to_largest(const Image& levels, int width);
Image cropped(const Image& image, int x, int y, int width, int height);

/// A part of a view.
struct Region {
  std::size_t pictures = 0;  ///< index into the searched list
  int x = 0, y = 0, width = 0, height = 0;
  double rms = 0;  ///< of its levels
};
/// The `n` regions of about width x height pixels with the largest squared error, worst first, without overlap and at
/// most `per_view` from one view. Omits regions without any difference.
std::vector<Region> worst_regions(std::span<const Image> levels, int width, int height, std::size_t n,
                                  std::size_t per_view);

/// "data:image/png;base64,..." if that fits into `max_bytes`, else JPEG of decreasing quality and then size. `lossless`
/// says which; may be null.
std::string picture_uri(const Image& image, std::size_t max_bytes, bool* lossless = nullptr);

}  // namespace rgs::audit
