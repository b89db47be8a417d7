// image_codec.hpp - what image_file.cpp asks of the module that knows other formats than PNG and JPEG.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "image_file.hpp"

namespace rgs {

/// What every picture of colours says about itself.
inline constexpr const char* kPictureDescription =
    "Display-referred sRGB values as trained by 3D Gaussian splatting; show without another transfer curve";

/// Small files can hold huge pictures.
inline Status check_size(ImageExtent extent) {
  constexpr std::uint64_t kMostPixels = 1 << 28;
  const std::uint64_t pixels = static_cast<std::uint64_t>(extent.width) * static_cast<std::uint64_t>(extent.height);
  if (pixels <= kMostPixels) return {};
  return make_error(Errc::limit_exceeded, Error::kNone, "a picture of too many pixels", kMostPixels, pixels);
}

/// Arguments are valid: image_file.cpp has checked them. Calls may run in several threads.
class ImageCodec {
 public:
  virtual ~ImageCodec() = default;
  /// A whole TIFF or OpenEXR file's bytes; false if the format cannot be written.
  virtual bool encode(const Image& image, ImageFormat format, const ImageFileOptions& options,
                      std::vector<std::byte>& bytes) const = 0;
  /// nullopt for a file that is no picture.
  virtual std::optional<ImageExtent> extent(const std::string& path) const = 0;
  /// nullopt for a file that is no picture, or a damaged one.
  virtual std::optional<Image> decode(const std::string& path) const = 0;
};

/// Errors: unavailable, host_out_of_memory.
Result<const ImageCodec*> load_image_module();

}  // namespace rgs

/// The module's entry.
extern "C" [[gnu::visibility("default")]] const rgs::ImageCodec* rgs_image_codec();
