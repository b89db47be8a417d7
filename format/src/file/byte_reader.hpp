// byte_reader.hpp - little-endian parsing with sticky failure: read a record, then check ok() once.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "rgs/quantize.hpp"

namespace rgs::detail {

class ByteReader {
 public:
  /// `origin`: file offset of bytes[0], for error messages.
  explicit ByteReader(std::span<const std::byte> bytes, std::uint64_t origin = 0) : bytes_(bytes), origin_(origin) {}

  std::uint8_t u8() { return static_cast<std::uint8_t>(integer(1)); }
  std::uint16_t u16() { return static_cast<std::uint16_t>(integer(2)); }
  std::int16_t i16() { return static_cast<std::int16_t>(u16()); }
  std::uint32_t u32() { return static_cast<std::uint32_t>(integer(4)); }
  std::uint64_t u64() { return integer(8); }
  float f32() { return float_of(u32()); }
  double f64() { return std::bit_cast<double>(u64()); }
  std::string text(std::uint64_t length) {
    if (!take(length)) return {};
    return {reinterpret_cast<const char*>(bytes_.data() + position_ - length), static_cast<std::size_t>(length)};
  }
  /// The next `count` bytes; empty if there are fewer.
  std::span<const std::byte> bytes(std::uint64_t count) {
    if (!take(count)) return {};
    return bytes_.subspan(static_cast<std::size_t>(position_ - count), static_cast<std::size_t>(count));
  }
  /// Consumes `count` bytes; false, with ok() still true, if they are not all zero.
  bool zeros(std::uint64_t count) {
    if (!take(count)) return true;
    for (std::uint64_t i = position_ - count; i < position_; ++i) {
      if (bytes_[i] != std::byte{0}) return false;
    }
    return true;
  }

  bool ok() const { return ok_; }
  std::uint64_t offset() const { return origin_ + position_; }
  std::uint64_t remaining() const { return bytes_.size() - position_; }

 private:
  bool take(std::uint64_t count) {
    if (!ok_ || count > bytes_.size() - position_) {
      ok_ = false;
      return false;
    }
    position_ += count;
    return true;
  }
  std::uint64_t integer(std::uint64_t count) {
    if (!take(count)) return 0;
    std::uint64_t value = 0;
    for (std::uint64_t i = 0; i < count; ++i) {
      value |= static_cast<std::uint64_t>(bytes_[position_ - count + i]) << (8 * i);
    }
    return value;
  }
  std::span<const std::byte> bytes_;
  std::uint64_t origin_;
  std::uint64_t position_ = 0;
  bool ok_ = true;
};

}  // namespace rgs::detail
