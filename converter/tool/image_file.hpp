// image_file.hpp - pictures to and from PNG, JPEG, TIFF and OpenEXR files.
// SPDX-License-Identifier: Apache-2.0
//
// Values are what 3DGS trains on: photographs' sRGB-encoded values, 0 to 1. They are ready for display and are written
// as they are, tagged as sRGB; nothing here applies a transfer curve. docs/format/RENDERING.md says more.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs {

enum class ImageFormat { png, jpeg, tiff, exr };

/// By the name's extension, any case: png, jpg, jpeg, tif, tiff, exr. bad_argument for others.
Result<ImageFormat> image_format(const std::string& path);

struct ImageFileOptions {
  AtomicFile::Options file{.overwrite = false, .sync = false};
  bool depth = false;      ///< the image [height, width, 1] is camera-space depth in world units, not colour
  int jpeg_quality = 95;   ///< 1..100; chroma is not subsampled
  int png_level = 6;       ///< of deflate, 0..9; the pixels are the same
  std::string software{};  ///< written as the picture's software tag if not empty
};

/// Writes `image` under `path` all or nothing; the format is image_format(path)'s.
/// Channels: 1 grey, 3 RGB, 4 RGBA whose colour is multiplied by alpha (a render over black). PNG, JPEG and TIFF hold
/// 8-bit codes, OpenEXR the FP32 values; PNG files hold colour divided by alpha, as their definition asks. Depth is
/// FP32 in TIFF or OpenEXR, where its channel is called Z. Equal images give equal bytes. Errors: bad_argument
/// (extension; alpha or more than 65,500 pixels a side in JPEG; depth in PNG or
/// JPEG; channels), output_exists, output_unusable, open_failed,
/// write_failed.
Status write_image(const std::string& path, const Image& image, const ImageFileOptions& options = {});

/// The bytes that write_image() would write, as PNG or JPEG; options.file and options.depth play no part.
/// Errors: bad_argument (TIFF and OpenEXR, for which write_image() is; alpha or size in JPEG; channels), write_failed.
Result<std::vector<std::byte>> encode_image(const Image& image, ImageFormat format,
                                            const ImageFileOptions& options = {});

struct ImageExtent {
  int width = 0, height = 0, channels = 0;
};
/// Size of a picture without reading its pixels. Errors: open_failed, bad_syntax.
Result<ImageExtent> read_image_extent(const std::string& path);

/// Reads any picture as FP32, integer codes divided by their maximum: what write_image wrote comes back, 8-bit codes c
/// as c / 255. Alpha, if there is any, is multiplied into colour. Errors: open_failed, bad_syntax.
Result<Image> read_image(const std::string& path);

}  // namespace rgs
