// image_file.hpp - reads and writes PNG, JPEG, TIFF and OpenEXR pictures.
// SPDX-License-Identifier: Apache-2.0
//
// Values are what 3DGS trains on: photographs' sRGB-encoded values, 0 to 1. They are ready for display and are written
// unchanged, tagged as sRGB, without a transfer curve. See docs/format/RENDERING.md.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs {

enum class ImageFormat { png, jpeg, tiff, exr };

/// From the name's extension, any case: png, jpg, jpeg, tif, tiff, exr. bad_argument for others.
Result<ImageFormat> image_format(const std::string& path);

// The program itself knows PNG and JPEG; a module beside it, which is loaded when it is needed, knows other formats.
// Functions that meet one may fail with unavailable (the module or a library of it is not there), host_out_of_memory.

/// Loads what `format` needs now: what cannot be written later is then refused before the work.
Status load_image_format(ImageFormat format);

struct ImageFileOptions {
  AtomicFile::Options file{.overwrite = false, .sync = false};
  bool depth = false;      ///< the image [height, width, 1] is depth in world units, not colour
  int jpeg_quality = 95;   ///< 1..100; chroma is not subsampled
  int png_level = 6;       ///< of deflate, 0..9; does not change pixels
  std::string software{};  ///< the picture's software tag, if not empty
};

/// Writes `image` to `path` atomically; the format is image_format(path).
/// Channels: 1 grey, 3 RGB, 4 RGBA with premultiplied colour (a render over black). PNG, JPEG and TIFF hold 8-bit
/// codes, OpenEXR the FP32 values; PNG holds colour divided by alpha, as its definition asks. Depth is FP32 in TIFF or
/// OpenEXR, where its channel is called Z. Equal images give equal bytes. Errors: bad_argument (extension; alpha or
/// more than 65,500 pixels a side in JPEG; depth in PNG or JPEG; channels), output_exists, output_unusable,
/// unavailable, write_failed.
Status write_image(const std::string& path, const Image& image, const ImageFileOptions& options = {});

/// An RGB picture with its alpha [height, width], as RGBA.
Image with_alpha(const Image& rgb, std::span<const float> alpha);

/// The bytes that write_image() would write as PNG or JPEG; ignores options.file and options.depth.
/// Errors: bad_argument (TIFF and OpenEXR; alpha or size in JPEG; channels), write_failed, host_out_of_memory.
Result<std::vector<std::byte>> encode_image(const Image& image, ImageFormat format,
                                            const ImageFileOptions& options = {});

struct ImageExtent {
  int width = 0, height = 0, channels = 0;
};
/// Size of a picture without reading its pixels. Errors: open_failed, bad_syntax, corrupt_data, unavailable.
Result<ImageExtent> read_image_extent(const std::string& path);

/// Reads any picture as FP32, integer codes divided by their maximum: inverts write_image(), with 8-bit codes c as c /
/// 255. Colour is premultiplied by alpha, if there is any. Errors: open_failed, bad_syntax, corrupt_data, unavailable,
/// limit_exceeded (PNG and JPEG of more than 2^28 pixels).
Result<Image> read_image(const std::string& path);

}  // namespace rgs
