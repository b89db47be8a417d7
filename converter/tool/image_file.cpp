// image_file.cpp - pictures are encoded in memory, what is neither PNG nor JPEG by a module, and written atomically.
// SPDX-License-Identifier: Apache-2.0
#include "image_file.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <filesystem>
#include <utility>
#include <vector>

#include "image_codec.hpp"
#include "jpeg_file.hpp"
#include "png_file.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

// Loaded at the first picture that needs it and kept.
const Result<const ImageCodec*>& module_codec() {
  static const Result<const ImageCodec*> codec = load_image_module();
  return codec;
}

Status check(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (image.channels != 1 && (options.depth || (image.channels != 3 && image.channels != 4)))
    return make_error(Errc::bad_argument, Error::kNone, "a picture has 1, 3 or 4 channels, and depth has 1");
  if (options.depth && (format == ImageFormat::png || format == ImageFormat::jpeg))
    return make_error(Errc::bad_argument, Error::kNone, "depth needs floating point: name the file .exr or .tif");
  if (image.channels == 4 && format == ImageFormat::jpeg)
    return make_error(Errc::bad_argument, Error::kNone, "JPEG has no alpha: name the file .png, .tif or .exr");
  constexpr int kMaxJpegSide = 65500;
  if (format == ImageFormat::jpeg && std::max(image.width, image.height) > kMaxJpegSide)
    return make_error(Errc::bad_argument, Error::kNone,
                      "JPEG holds at most 65,500 pixels a side: name the file .png, .tif or .exr");
  return {};
}

Result<std::vector<std::byte>> encode(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (format == ImageFormat::png) return encode_png(image, options);
  if (format == ImageFormat::jpeg) return encode_jpeg(image, options);
  if (!module_codec()) return tl::unexpected(module_codec().error());
  std::vector<std::byte> bytes;
  if ((*module_codec())->encode(image, format, options, bytes)) return bytes;
  return make_error(Errc::write_failed, Error::kNone, "the picture cannot be encoded");
}

// What a file holds, by `png` or `jpeg` of its bytes or by the module's `other` of its path.
template <class Png, class Jpeg, class Other>
auto read(const std::string& path, Png png, Jpeg jpeg, Other other) -> decltype(png({})) {
  const auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  if (is_png(file->bytes())) return png(file->bytes());
  if (is_jpeg(file->bytes())) return jpeg(file->bytes());
  if (!module_codec()) return tl::unexpected(module_codec().error());
  if (auto found = (**module_codec().*other)(path)) return *std::move(found);
  return make_error(Errc::bad_syntax, Error::kNone, "not a picture format that OpenImageIO reads, or damaged");
}

}  // namespace

Result<ImageFormat> image_format(const std::string& path) {
  std::string extension = detail::path_of(path).extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  constexpr std::array<std::pair<const char*, ImageFormat>, 6> kNames{{{".png", ImageFormat::png},
                                                                       {".jpg", ImageFormat::jpeg},
                                                                       {".jpeg", ImageFormat::jpeg},
                                                                       {".tif", ImageFormat::tiff},
                                                                       {".tiff", ImageFormat::tiff},
                                                                       {".exr", ImageFormat::exr}}};
  for (const auto& [name, format] : kNames)
    if (extension == name) return format;
  return make_error(Errc::bad_argument, Error::kNone, "a picture's name must end in .png, .jpg, .tif or .exr");
}

Status write_image(const std::string& path, const Image& image, const ImageFileOptions& options) {
  const auto format = image_format(path);
  if (!format) return tl::unexpected(format.error());
  if (const Status s = check(image, *format, options); !s) return s;
  auto file = AtomicFile::create(path, options.file);
  if (!file) return tl::unexpected(file.error());
  const auto bytes = encode(image, *format, options);
  if (!bytes) return tl::unexpected(bytes.error());
  if (auto status = file->write_at(0, *bytes); !status) return status;
  return file->commit().map([](double) {});
}

Image with_alpha(const Image& rgb, std::span<const float> alpha) {
  Image rgba = Image::make(rgb.width, rgb.height, 4);
  for (std::size_t i = 0; i < alpha.size(); ++i) {
    std::copy_n(rgb.pixels.data() + 3 * i, 3, rgba.pixels.data() + 4 * i);
    rgba.pixels[4 * i + 3] = alpha[i];
  }
  return rgba;
}

Result<std::vector<std::byte>> encode_image(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (format != ImageFormat::png && format != ImageFormat::jpeg)
    return make_error(Errc::bad_argument, Error::kNone, "only PNG and JPEG can be encoded in memory");
  ImageFileOptions colour = options;
  colour.depth = false;
  if (const Status s = check(image, format, colour); !s) return tl::unexpected(s.error());
  return encode(image, format, colour);
}

Status load_image_format(ImageFormat format) {
  if (format == ImageFormat::png || format == ImageFormat::jpeg) return {};
  return module_codec().map([](const ImageCodec*) {});
}

Result<ImageExtent> read_image_extent(const std::string& path) {
  return read(path, png_extent, jpeg_extent, &ImageCodec::extent);
}

Result<Image> read_image(const std::string& path) {
  return read(path, decode_png, decode_jpeg, &ImageCodec::decode);
}

}  // namespace rgs
