// png_file.cpp - libpng reports an error by longjmp: no destructor may be between it and `guarded()`.
// SPDX-License-Identifier: Apache-2.0
#include "png_file.hpp"

#include <png.h>
#include <zlib.h>

#include <algorithm>
#include <csetjmp>
#include <cstdint>
#include <cstring>
#include <new>
#include <type_traits>
#include <utility>

#include "image_codec.hpp"

namespace rgs {
namespace {

// Deflate makes one byte of at most so many.
constexpr std::uint64_t kMostExpansion = 1032;

[[noreturn]] void stop(png_structp png, png_const_charp) {
  png_longjmp(png, 1);
}

void ignore(png_structp, png_const_charp) {}

// Calls `work`, which must have nothing to destroy; false if libpng has stopped it.
template <class Work>
bool guarded(png_structp png, const Work& work) {
  static_assert(std::is_trivially_destructible_v<Work>);
  if (setjmp(png_jmpbuf(png)) != 0) return false;
  work();
  return true;
}

class Decoder {
 public:
  explicit Decoder(std::span<const std::byte> file)
      : rest_(file), png_(png_create_read_struct(PNG_LIBPNG_VER_STRING, nullptr, stop, ignore)) {
    if (png_ != nullptr) info_ = png_create_info_struct(png_);
    if (info_ != nullptr) return;
    png_destroy_read_struct(&png_, nullptr, nullptr);
    throw std::bad_alloc();
  }
  Decoder(const Decoder&) = delete;
  Decoder& operator=(const Decoder&) = delete;
  ~Decoder() { png_destroy_read_struct(&png_, &info_, nullptr); }

  // Reads all before the pixels; false for a damaged file.
  bool start() {
    const std::uint64_t n_bytes = rest_.size();
    const bool read = guarded(png_, [this] {
      png_set_read_fn(png_, &rest_, take);
      // Sizes are compared with the file's instead.
      png_set_user_limits(png_, PNG_UINT_31_MAX, PNG_UINT_31_MAX);
      png_set_crc_action(png_, PNG_CRC_ERROR_QUIT, PNG_CRC_ERROR_QUIT);
      png_read_info(png_, info_);
    });
    if (!read) return false;
    const std::uint64_t row_bytes = png_get_rowbytes(png_, info_), height = png_get_image_height(png_, info_);
    if (row_bytes == 0 || height > kMostExpansion * n_bytes / row_bytes) return false;
    return guarded(png_, [this] {
      png_set_expand(png_);
      (void)png_set_interlace_handling(png_);
      png_read_update_info(png_, info_);
    });
  }

  ImageExtent extent() const {
    return {static_cast<int>(png_get_image_width(png_, info_)), static_cast<int>(png_get_image_height(png_, info_)),
            png_get_channels(png_, info_)};
  }
  bool is_16bit() const { return png_get_bit_depth(png_, info_) == 16; }
  std::size_t row_bytes() const { return png_get_rowbytes(png_, info_); }

  bool read(std::uint8_t** rows) {
    return guarded(png_, [this, rows] { png_read_image(png_, rows); });
  }

 private:
  static void take(png_structp png, png_bytep out, std::size_t n) {
    auto& rest = *static_cast<std::span<const std::byte>*>(png_get_io_ptr(png));
    if (n > rest.size()) png_error(png, "the file ends");
    std::memcpy(out, rest.data(), n);
    rest = rest.subspan(n);
  }

  std::span<const std::byte> rest_;
  png_structp png_ = nullptr;
  png_infop info_ = nullptr;
};

tl::unexpected<Error> damaged() {
  return make_error(Errc::corrupt_data, Error::kNone, "a damaged PNG, or one that ends early");
}

void multiply_by_alpha(Image& image) {
  const auto stride = static_cast<std::size_t>(image.channels);
  for (std::size_t i = 0; i < image.pixels.size(); i += stride)
    for (std::size_t c = 0; c + 1 < stride; ++c) image.pixels[i + c] *= image.pixels[i + stride - 1];
}

// Colour is divided before rounding: dividing 8-bit codes would lose precision where alpha is small.
std::vector<std::uint8_t> straight_codes(const Image& image) {
  std::vector<std::uint8_t> codes(image.pixels.size());
  const auto stride = static_cast<std::size_t>(image.channels);
  for (std::size_t i = 0; i < codes.size(); i += stride) {
    const float alpha = stride == 4 ? image.pixels[i + 3] : 1;
    for (std::size_t c = 0; c < stride; ++c) {
      const float v = image.pixels[i + c];
      codes[i + c] = to_8bit(c < 3 && alpha > 0 ? v / alpha : v);
    }
  }
  return codes;
}

class Encoder {
 public:
  Encoder() : png_(png_create_write_struct(PNG_LIBPNG_VER_STRING, nullptr, stop, ignore)) {
    if (png_ != nullptr) info_ = png_create_info_struct(png_);
    if (info_ != nullptr) return;
    png_destroy_write_struct(&png_, nullptr);
    throw std::bad_alloc();
  }
  Encoder(const Encoder&) = delete;
  Encoder& operator=(const Encoder&) = delete;
  ~Encoder() { png_destroy_write_struct(&png_, &info_); }

  bool write(const Image& image, const ImageFileOptions& options, const std::uint8_t* codes) {
    const std::size_t row_bytes = static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.channels);
    return guarded(png_, [&] {
      png_set_write_fn(png_, &bytes_, append, nullptr);
      png_set_user_limits(png_, PNG_UINT_31_MAX, PNG_UINT_31_MAX);
      png_set_compression_level(png_, options.png_level);
      png_set_compression_strategy(png_, Z_DEFAULT_STRATEGY);  // renders become smaller than by libpng's choice
      const int type = image.channels == 1   ? PNG_COLOR_TYPE_GRAY
                       : image.channels == 3 ? PNG_COLOR_TYPE_RGB
                                             : PNG_COLOR_TYPE_RGB_ALPHA;
      png_set_IHDR(png_, info_, static_cast<png_uint_32>(image.width), static_cast<png_uint_32>(image.height), 8, type,
                   PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
      png_set_sRGB_gAMA_and_cHRM(png_, info_, PNG_sRGB_INTENT_ABSOLUTE);
      set_text("Description", kPictureDescription);
      if (!options.software.empty()) set_text("Software", options.software.c_str());
      png_write_info(png_, info_);
      for (int y = 0; y < image.height; ++y) png_write_row(png_, codes + static_cast<std::size_t>(y) * row_bytes);
      png_write_end(png_, nullptr);
    });
  }
  std::vector<std::byte> bytes() && { return std::move(bytes_); }

 private:
  void set_text(const char* key, const char* value) {
    png_text text{};
    text.compression = PNG_TEXT_COMPRESSION_NONE;
    text.key = const_cast<char*>(key);  // libpng does not write there
    text.text = const_cast<char*>(value);
    png_set_text(png_, info_, &text, 1);
  }
  static void append(png_structp png, png_bytep data, std::size_t n) {
    auto& bytes = *static_cast<std::vector<std::byte>*>(png_get_io_ptr(png));
    bool fits = true;
    try {
      bytes.insert(bytes.end(), reinterpret_cast<std::byte*>(data), reinterpret_cast<std::byte*>(data) + n);
    } catch (const std::bad_alloc&) {
      fits = false;
    }
    if (!fits) png_error(png, "memory has run out");
  }

  png_structp png_ = nullptr;
  png_infop info_ = nullptr;
  std::vector<std::byte> bytes_;
};

}  // namespace

Result<std::vector<std::byte>> encode_png(const Image& image, const ImageFileOptions& options) {
  const std::vector<std::uint8_t> codes = straight_codes(image);
  Encoder encoder;
  // A valid picture: only memory can be missing.
  if (!encoder.write(image, options, codes.data()))
    return make_error(Errc::host_out_of_memory, Error::kNone, "memory has run out");
  return std::move(encoder).bytes();
}

bool is_png(std::span<const std::byte> file) {
  constexpr std::size_t kSignature = 8;
  return file.size() >= kSignature && png_sig_cmp(reinterpret_cast<png_const_bytep>(file.data()), 0, kSignature) == 0;
}

Result<ImageExtent> png_extent(std::span<const std::byte> file) {
  Decoder decoder(file);
  if (!decoder.start()) return damaged();
  return decoder.extent();
}

Result<Image> decode_png(std::span<const std::byte> file) {
  Decoder decoder(file);
  if (!decoder.start()) return damaged();
  if (const Status s = check_size(decoder.extent()); !s) return tl::unexpected(s.error());
  const auto [width, height, channels] = decoder.extent();
  const std::size_t row_bytes = decoder.row_bytes();
  std::vector<std::uint8_t> codes(row_bytes * static_cast<std::size_t>(height));
  std::vector<std::uint8_t*> rows(static_cast<std::size_t>(height));
  for (std::size_t y = 0; y < rows.size(); ++y) rows[y] = codes.data() + y * row_bytes;
  if (!decoder.read(rows.data())) return damaged();
  Image image = Image::make(width, height, channels);
  const bool is_16bit = decoder.is_16bit();
  for (std::size_t i = 0; i < image.pixels.size(); ++i)
    image.pixels[i] = is_16bit ? static_cast<float>(codes[2 * i] << 8 | codes[2 * i + 1]) / 65535.F
                               : static_cast<float>(codes[i]) / 255.F;
  if (channels % 2 == 0) multiply_by_alpha(image);
  return image;
}

}  // namespace rgs
