// byte_writer.hpp - little-endian serialisation, field by field.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "rgs/quantize.hpp"

namespace rgs::detail {

class ByteWriter {
 public:
  void u8(std::uint8_t value) { bytes_.push_back(std::byte{value}); }
  void u16(std::uint16_t value) { integer(value, 2); }
  void i16(std::int16_t value) { u16(static_cast<std::uint16_t>(value)); }
  void u32(std::uint32_t value) { integer(value, 4); }
  void u64(std::uint64_t value) { integer(value, 8); }
  void f32(float value) { u32(bits_of(value)); }
  void f64(double value) { u64(std::bit_cast<std::uint64_t>(value)); }
  void text(const std::string& value) {
    for (const char c : value) u8(static_cast<std::uint8_t>(c));
  }
  void zeros(std::size_t count) { bytes_.resize(bytes_.size() + count); }
  /// Appends zeros up to a total of `size` bytes.
  void pad_to(std::size_t size) { bytes_.resize(size); }

  const std::vector<std::byte>& bytes() const { return bytes_; }
  std::vector<std::byte> take() { return std::move(bytes_); }

 private:
  void integer(std::uint64_t value, int count) {
    for (int i = 0; i < count; ++i) u8(static_cast<std::uint8_t>(value >> (8 * i) & 255));
  }
  std::vector<std::byte> bytes_;
};

}  // namespace rgs::detail
