// image_file.cpp - pictures through OpenImageIO, encoded in memory and then written atomically.
// SPDX-License-Identifier: Apache-2.0
#include "image_file.hpp"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <filesystem>
#include <memory>
#include <span>
#include <utility>
#include <vector>

namespace rgs {
namespace {

constexpr const char* kDescription =
    "Display-referred sRGB values as trained by 3D Gaussian splatting; show without another transfer curve";

// A file in memory that can be read back, as libtiff requires; OpenImageIO's own memory output cannot.
class MemoryFile final : public OIIO::Filesystem::IOProxy {
 public:
  MemoryFile() : IOProxy("", Write) {}
  const char* proxytype() const override { return "memory"; }
  std::size_t size() const override { return bytes_.size(); }
  std::vector<std::byte> bytes() && { return std::move(bytes_); }

  std::size_t read(void* out, std::size_t n) override {
    n = pread(out, n, m_pos);
    m_pos += static_cast<std::int64_t>(n);
    return n;
  }
  std::size_t write(const void* in, std::size_t n) override {
    n = pwrite(in, n, m_pos);
    m_pos += static_cast<std::int64_t>(n);
    return n;
  }
  std::size_t pread(void* out, std::size_t n, std::int64_t offset) override {
    const auto from = std::min(static_cast<std::size_t>(offset), bytes_.size());
    n = std::min(n, bytes_.size() - from);
    std::copy_n(bytes_.data() + from, n, static_cast<std::byte*>(out));
    return n;
  }
  std::size_t pwrite(const void* in, std::size_t n, std::int64_t offset) override {
    const auto from = static_cast<std::size_t>(offset);
    if (from + n > bytes_.size()) bytes_.resize(from + n);
    std::copy_n(static_cast<const std::byte*>(in), n, bytes_.data() + from);
    return n;
  }

 private:
  std::vector<std::byte> bytes_;
};

// Colour divided by alpha before rounding: dividing 8-bit codes would lose precision where alpha is small.
std::vector<float> unassociated(const Image& image) {
  std::vector<float> pixels = image.pixels;
  for (std::size_t i = 0; i + 3 < pixels.size(); i += 4)
    if (pixels[i + 3] > 0)
      for (std::size_t c = 0; c < 3; ++c) pixels[i + c] /= pixels[i + 3];
  return pixels;
}

OIIO::ImageSpec specification(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  const bool floating = format == ImageFormat::exr || options.depth;
  OIIO::ImageSpec spec(image.width, image.height, image.channels,
                       floating ? OIIO::TypeDesc::FLOAT : OIIO::TypeDesc::UINT8);
  if (!options.software.empty()) spec.attribute("Software", options.software);
  if (options.depth) {
    spec.channelnames = {"Z"};
    spec.z_channel = 0;
    spec.attribute("ImageDescription", "Depth along the camera's forward axis in world units, 0 for no surface");
  } else {
    // In TIFF the tag would become an Exif directory, which the library writes over the picture's own in memory files.
    if (format != ImageFormat::tiff) spec.attribute("oiio:ColorSpace", "sRGB");
    spec.attribute("ImageDescription", kDescription);
  }
  switch (format) {
    case ImageFormat::png:
      spec.attribute("oiio:UnassociatedAlpha", 1);
      spec.attribute("png:compressionLevel", options.png_level);
      break;
    case ImageFormat::jpeg:
      spec.attribute("Compression", "jpeg:" + std::to_string(options.jpeg_quality));
      spec.attribute("jpeg:subsampling", "4:4:4");
      break;
    case ImageFormat::tiff:
    case ImageFormat::exr:
      spec.attribute("compression", "zip");
      spec.attribute("DateTime", "    :  :     :  :  ");  // "unknown" in TIFF; the default is the current time, so
                                                          // bytes would differ
      break;
  }
  return spec;
}

Result<std::unique_ptr<OIIO::ImageInput>> open_image(const std::string& path) {
  // Finds out why a file cannot be opened; the library does not say.
  if (const auto mapped = MappedFile::open(path); !mapped) return tl::unexpected(mapped.error());
  auto input = OIIO::ImageInput::open(path);
  if (input) return input;
  (void)OIIO::geterror();
  return make_error(Errc::bad_syntax, Error::kNone, "not a picture format that OpenImageIO reads");
}

const char* extension(ImageFormat format) {
  switch (format) {
    case ImageFormat::png: return "png";
    case ImageFormat::jpeg: return "jpg";
    case ImageFormat::tiff: return "tif";
    case ImageFormat::exr: return "exr";
  }
  return "";
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
  const std::string name = extension(format);
  const auto output = OIIO::ImageOutput::create(name);
  if (!output)
    return make_error(Errc::write_failed, Error::kNone, "this build of OpenImageIO cannot write the picture's format");
  MemoryFile memory;
  bool written = output->set_ioproxy(&memory) && output->open("picture." + name, specification(image, format, options));
  if (written && format != ImageFormat::exr && !options.depth) {
    const bool divide = format == ImageFormat::png && image.channels == 4;
    const std::vector<float> straight = divide ? unassociated(image) : std::vector<float>();
    const std::vector<float>& source = divide ? straight : image.pixels;
    std::vector<std::uint8_t> codes(source.size());
    std::transform(source.begin(), source.end(), codes.begin(), to_8bit);
    written = output->write_image(OIIO::TypeDesc::UINT8, codes.data());
  } else if (written) {
    written = output->write_image(OIIO::TypeDesc::FLOAT, image.pixels.data());
  }
  written = output->close() && written;
  if (!written) {
    (void)output->geterror();  // fetched, or the destructor prints it
    return make_error(Errc::write_failed, Error::kNone, "the picture cannot be encoded");
  }
  return std::move(memory).bytes();
}

}  // namespace

Result<ImageFormat> image_format(const std::string& path) {
  std::string extension = std::filesystem::path(path).extension().string();
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

Result<std::vector<std::byte>> encode_image(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  if (format != ImageFormat::png && format != ImageFormat::jpeg)
    return make_error(Errc::bad_argument, Error::kNone, "only PNG and JPEG can be encoded in memory");
  ImageFileOptions colour = options;
  colour.depth = false;
  if (const Status s = check(image, format, colour); !s) return tl::unexpected(s.error());
  return encode(image, format, colour);
}

Result<ImageExtent> read_image_extent(const std::string& path) {
  const auto input = open_image(path);
  if (!input) return tl::unexpected(input.error());
  const OIIO::ImageSpec& spec = (*input)->spec();
  return ImageExtent{spec.width, spec.height, spec.nchannels};
}

Result<Image> read_image(const std::string& path) {
  const auto input = open_image(path);
  if (!input) return tl::unexpected(input.error());
  const OIIO::ImageSpec& spec = (*input)->spec();
  Image image = Image::make(spec.width, spec.height, spec.nchannels);
  if (!(*input)->read_image(0, 0, 0, spec.nchannels, OIIO::TypeDesc::FLOAT, image.pixels.data())) {
    (void)(*input)->geterror();
    return make_error(Errc::bad_syntax, Error::kNone, "the picture is damaged");
  }
  return image;
}

}  // namespace rgs
