// jpeg.hpp - a fast JPEG encoder, chroma at half the resolution.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::view {

/// Reuses its memory. Not thread-safe.
class JpegEncoder {
 public:
  JpegEncoder();
  /// `rgb` [height, width, 3] as a JPEG file; quality 1..100. Error: internal (libjpeg-turbo fails).
  Result<std::string> encode(std::span<const std::uint8_t> rgb, int width, int height, int quality);

 private:
  std::unique_ptr<void, int (*)(void*)> turbo_;
  std::vector<unsigned char> bytes_;
};

}  // namespace rgs::view
