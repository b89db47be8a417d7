// jpeg_file.hpp - JPEG pictures, by libjpeg-turbo.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "image_file.hpp"

namespace rgs {

/// `image` [height, width, 1 or 3] as a file; chroma is not subsampled. Error: internal (libjpeg-turbo fails).
Result<std::vector<std::byte>> encode_jpeg(const Image& image, const ImageFileOptions& options);

/// Whether a file begins as a JPEG does.
bool is_jpeg(std::span<const std::byte> file);

/// Error: corrupt_data.
Result<ImageExtent> jpeg_extent(std::span<const std::byte> file);

/// Grey or RGB, also of CMYK; as it is stored, whatever orientation Exif states. Error: corrupt_data.
Result<Image> decode_jpeg(std::span<const std::byte> file);

}  // namespace rgs
