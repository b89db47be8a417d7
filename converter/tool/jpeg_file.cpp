// jpeg_file.cpp - libjpeg-turbo's TurboJPEG, with the comments that it does not write.
// SPDX-License-Identifier: Apache-2.0
#include "jpeg_file.hpp"

#include <turbojpeg.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <string>

#include "image_codec.hpp"

namespace rgs {
namespace {

using Turbo = std::unique_ptr<void, int (*)(void*)>;

Turbo owned(tjhandle handle) {
  if (handle == nullptr) throw std::bad_alloc();
  return {handle, tjDestroy};
}

// Big-endian, as the numbers of JPEG and of an Exif directory that says "MM".
std::string u16(std::size_t value) {
  return {static_cast<char>(value >> 8 & 0xFF), static_cast<char>(value & 0xFF)};
}
std::string u32(std::size_t value) {
  return u16(value >> 16) + u16(value);
}

std::string segment(char marker, const std::string& content) {
  return std::string{'\xFF', marker} + u16(content.size() + 2) + content;
}

// An Exif directory with the colour space, sRGB, and the software's name.
std::string exif(const std::string& software) {
  constexpr std::size_t kAscii = 2, kShort = 3, kLong = 4, kEntry = 12;
  const auto entry = [](std::size_t tag, std::size_t type, std::size_t n, const std::string& value) {
    return u16(tag) + u16(type) + u32(n) + value;
  };
  const std::string text = software + std::string(5, '\0');  // up to four bytes would be in the entry
  const std::size_t n = software.empty() ? 1 : 2, colours = 8 + 2 + n * kEntry + 4, text_at = colours + 2 + kEntry + 4;
  std::string out = std::string("Exif\0\0MM\0*", 10) + u32(8) + u16(n);
  if (n == 2) out += entry(0x0131, kAscii, text.size(), u32(text_at));
  out += entry(0x8769, kLong, 1, u32(colours)) + u32(0);
  out += u16(1) + entry(0xA001, kShort, 1, u16(1) + u16(0)) + u32(0);
  return n == 2 ? out + text : out;
}

struct Head {
  ImageExtent extent;
  bool cmyk = false;
};

tl::unexpected<Error> damaged() {
  return make_error(Errc::corrupt_data, Error::kNone, "a JPEG that is damaged, ends early or is of an unknown kind");
}

Result<Head> read_head(const Turbo& turbo, std::span<const std::byte> file) {
  int width = 0, height = 0, sampling = 0, colours = -1;
  const auto* bytes = reinterpret_cast<const unsigned char*>(file.data());
  // It fails also for a sampling that it has no name for, which it decodes all the same.
  (void)tjDecompressHeader3(turbo.get(), bytes, static_cast<unsigned long>(file.size()), &width, &height, &sampling,
                            &colours);
  if (width < 1 || height < 1 || colours < 0) return damaged();
  // A block of most 32 x 32 pixels has a bit at least.
  constexpr std::uint64_t kMostPixelsPerByte = 8 * 32 * 32;
  if (static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height) > kMostPixelsPerByte * file.size())
    return damaged();
  return Head{{width, height, colours == TJCS_GRAY ? 1 : 3}, colours == TJCS_CMYK || colours == TJCS_YCCK};
}

}  // namespace

Result<std::vector<std::byte>> encode_jpeg(const Image& image, const ImageFileOptions& options) {
  std::vector<std::uint8_t> codes(image.pixels.size());
  std::transform(image.pixels.begin(), image.pixels.end(), codes.begin(), to_8bit);
  const Turbo turbo = owned(tjInitCompress());
  const bool grey = image.channels == 1;
  const int sampling = grey ? TJSAMP_GRAY : TJSAMP_444;
  std::vector<unsigned char> coded(tjBufSize(image.width, image.height, sampling));
  unsigned char* out = coded.data();
  auto size = static_cast<unsigned long>(coded.size());
  if (tjCompress2(turbo.get(), codes.data(), image.width, 0, image.height, grey ? TJPF_GRAY : TJPF_RGB, &out, &size,
                  sampling, options.jpeg_quality, TJFLAG_NOREALLOC | TJFLAG_ACCURATEDCT) != 0)
    return make_error(Errc::write_failed, Error::kNone, "the picture cannot be encoded as JPEG");
  std::string notes = segment('\xFE', kPictureDescription);
  notes += segment('\xE1', exif(options.software));
  // Behind JFIF's segment, which comes first.
  const std::size_t head = 4 + std::size_t{coded[4]} * 256 + coded[5];
  std::vector<std::byte> bytes(size + notes.size());
  std::memcpy(bytes.data(), coded.data(), head);
  std::memcpy(bytes.data() + head, notes.data(), notes.size());
  std::memcpy(bytes.data() + head + notes.size(), coded.data() + head, size - head);
  return bytes;
}

bool is_jpeg(std::span<const std::byte> file) {
  return file.size() >= 3 && std::memcmp(file.data(), "\xFF\xD8\xFF", 3) == 0;
}

Result<ImageExtent> jpeg_extent(std::span<const std::byte> file) {
  return read_head(owned(tjInitDecompress()), file).map([](const Head& head) { return head.extent; });
}

Result<Image> decode_jpeg(std::span<const std::byte> file) {
  const Turbo turbo = owned(tjInitDecompress());
  const auto head = read_head(turbo, file);
  if (!head) return tl::unexpected(head.error());
  if (const Status s = check_size(head->extent); !s) return tl::unexpected(s.error());
  const auto [width, height, channels] = head->extent;
  const std::size_t n_pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  const int format = head->cmyk ? TJPF_CMYK : channels == 1 ? TJPF_GRAY : TJPF_RGB;
  std::vector<std::uint8_t> codes(n_pixels * static_cast<std::size_t>(tjPixelSize[format]));
  // Other warnings say that something is missing, which decoders fill with grey.
  if (tjDecompress2(turbo.get(), reinterpret_cast<const unsigned char*>(file.data()),
                    static_cast<unsigned long>(file.size()), codes.data(), width, 0, height, format,
                    TJFLAG_LIMITSCANS) != 0 &&
      std::strstr(tjGetErrorStr2(turbo.get()), "extraneous bytes") == nullptr)
    return damaged();
  Image image = Image::make(width, height, channels);
  for (std::size_t i = 0; i < image.pixels.size(); ++i) {
    // Adobe stores inks inverted.
    const float ink = head->cmyk ? static_cast<float>(codes[i / 3 * 4 + 3]) / 255.F : 1;
    image.pixels[i] = static_cast<float>(codes[head->cmyk ? i / 3 * 4 + i % 3 : i]) / 255.F * ink;
  }
  return image;
}

}  // namespace rgs
