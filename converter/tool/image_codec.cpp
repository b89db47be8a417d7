// image_codec.cpp - pictures that are neither PNG nor JPEG, by OpenImageIO: a module that image_file.cpp loads with the
// first of them. The library brings 260 others along, and starting with them takes a third of a second.
// SPDX-License-Identifier: Apache-2.0
#include "image_codec.hpp"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

namespace rgs {
namespace {

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

OIIO::ImageSpec specification(const Image& image, ImageFormat format, const ImageFileOptions& options) {
  const bool floating = format == ImageFormat::exr || options.depth;
  OIIO::ImageSpec spec(image.width, image.height, image.channels,
                       floating ? OIIO::TypeDesc::FLOAT : OIIO::TypeDesc::UINT8);
  if (!options.software.empty()) spec.attribute("Software", options.software);
  if (options.depth) {
    spec.channelnames = {"Z"};
    spec.z_channel = 0;
    spec.attribute("ImageDescription", "Depth in world units, 0 for no surface");
  } else {
    // In TIFF the tag would become an Exif directory, which the library writes over the picture's own in memory files.
    if (format != ImageFormat::tiff) spec.attribute("oiio:ColorSpace", "sRGB");
    spec.attribute("ImageDescription", kPictureDescription);
  }
  spec.attribute("compression", "zip");
  // "Unknown" in TIFF; the default is the current time, so bytes would differ.
  spec.attribute("DateTime", "    :  :     :  :  ");
  return spec;
}

class OpenImageIoCodec final : public ImageCodec {
 public:
  bool encode(const Image& image, ImageFormat format, const ImageFileOptions& options,
              std::vector<std::byte>& bytes) const override {
    const std::string name = format == ImageFormat::tiff ? "tif" : "exr";
    const auto output = OIIO::ImageOutput::create(name);
    if (!output) return false;
    MemoryFile memory;
    bool written =
        output->set_ioproxy(&memory) && output->open("picture." + name, specification(image, format, options));
    if (written && format != ImageFormat::exr && !options.depth) {
      std::vector<std::uint8_t> codes(image.pixels.size());
      std::transform(image.pixels.begin(), image.pixels.end(), codes.begin(), to_8bit);
      written = output->write_image(OIIO::TypeDesc::UINT8, codes.data());
    } else if (written) {
      written = output->write_image(OIIO::TypeDesc::FLOAT, image.pixels.data());
    }
    written = output->close() && written;
    if (!written) (void)output->geterror();  // fetched, or the destructor prints it
    bytes = std::move(memory).bytes();
    return written;
  }

  std::optional<ImageExtent> extent(const std::string& path) const override {
    const auto input = open(path);
    if (!input) return std::nullopt;
    const OIIO::ImageSpec& spec = input->spec();
    return ImageExtent{spec.width, spec.height, spec.nchannels};
  }

  std::optional<Image> decode(const std::string& path) const override {
    const auto input = open(path);
    if (!input) return std::nullopt;
    const OIIO::ImageSpec& spec = input->spec();
    Image image = Image::make(spec.width, spec.height, spec.nchannels);
    if (input->read_image(0, 0, 0, spec.nchannels, OIIO::TypeDesc::FLOAT, image.pixels.data())) return image;
    (void)input->geterror();
    return std::nullopt;
  }

 private:
  static std::unique_ptr<OIIO::ImageInput> open(const std::string& path) {
    auto input = OIIO::ImageInput::open(path);
    if (!input) (void)OIIO::geterror();
    return input;
  }
};

}  // namespace
}  // namespace rgs

const rgs::ImageCodec* rgs_image_codec() {
  static const rgs::OpenImageIoCodec codec;
  return &codec;
}
