// jpeg.hpp - JPEG for pictures that are looked at once: as fast as it gets, chroma at half the resolution.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>

#include "rgs/result.hpp"

namespace rgs::view {

/// `rgb` [height, width, 3] as a JPEG file; quality 1..100. Error: internal (libjpeg-turbo refuses).
Result<std::string> encode_jpeg(std::span<const std::uint8_t> rgb, int width, int height, int quality);

}  // namespace rgs::view
