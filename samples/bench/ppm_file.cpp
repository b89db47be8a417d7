// ppm_file.cpp - binary PPM pictures.
// SPDX-License-Identifier: Apache-2.0
#include "ppm_file.hpp"

#include <charconv>
#include <cstdint>
#include <string_view>

#include "rgs/file.hpp"

namespace rgs::bench {
namespace {

constexpr bool is_space(char c) {
  return c == ' ' || (c >= '\t' && c <= '\r');
}

// Skips white space, at least one byte of it, and comments, which run from '#' to the end of a line.
bool skip_space(std::string_view text, std::size_t& at) {
  const std::size_t begin = at;
  for (bool comment = false; at < text.size() && (comment || is_space(text[at]) || text[at] == '#'); ++at) {
    comment = text[at] == '#' || (comment && text[at] != '\n' && text[at] != '\r');
  }
  return at > begin;
}

}  // namespace

Result<Image> parse_ppm(std::span<const std::byte> bytes) {
  const std::string_view text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  if (!text.starts_with("P6")) return make_error(Errc::bad_magic, 0, "not a binary PPM picture (P6)");
  constexpr int kMaxSide = 65536, kMaxCode = 255;
  int numbers[3];  // width, height, largest code
  std::size_t at = 2;
  for (int& number : numbers) {
    const bool separated = skip_space(text, at);
    const auto [end, error] = std::from_chars(text.data() + at, text.data() + text.size(), number);
    if (!separated || error != std::errc() || number < 1 || number > kMaxSide) {
      return make_error(Errc::bad_syntax, at, "a PPM header is P6, width, height and 255 (sides 1 to 65536)");
    }
    at = static_cast<std::size_t>(end - text.data());
  }
  const auto [width, height, largest] = numbers;
  if (largest != kMaxCode) {
    return make_error(Errc::unsupported_feature, at, "only PPM pictures with 8 bits a channel are read", kMaxCode,
                      static_cast<std::uint64_t>(largest));
  }
  if (at == text.size() || !is_space(text[at])) return make_error(Errc::bad_syntax, at, "one space ends a PPM header");
  ++at;
  const std::size_t size = 3 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  if (text.size() - at < size)
    return make_error(Errc::truncated, text.size(), "the pixels end early", size, text.size() - at);
  if (text.size() - at > size) return make_error(Errc::trailing_bytes, at + size, "bytes after the last pixel");
  Image image = Image::make(width, height, 3);
  for (std::size_t i = 0; i < size; ++i) {
    image.pixels[i] = static_cast<float>(std::to_integer<int>(bytes[at + i])) / static_cast<float>(kMaxCode);
  }
  return image;
}

Result<Image> read_ppm(const std::string& path) {
  const auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  return parse_ppm(file->bytes());
}

}  // namespace rgs::bench
