// png_file.hpp - PNG pictures, by libpng.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "image_file.hpp"

namespace rgs {

/// `image` [height, width, 1, 3 or 4] as a file. Colour is divided by alpha before it is rounded.
Result<std::vector<std::byte>> encode_png(const Image& image, const ImageFileOptions& options);

/// Whether a file begins as a PNG does.
bool is_png(std::span<const std::byte> file);

/// Palettes and transparent colours count as channels. Error: corrupt_data.
Result<ImageExtent> png_extent(std::span<const std::byte> file);

/// Codes divided by their maximum, colour multiplied by alpha; gamma and ICC profiles are not applied.
/// Error: corrupt_data.
Result<Image> decode_png(std::span<const std::byte> file);

}  // namespace rgs
