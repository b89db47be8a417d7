// byte_range.hpp - which bytes of a file a request asks for (RFC 9110, section 14).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string_view>

namespace rgs::view {

/// Bytes [first, first + count).
struct ByteRange {
  enum class Kind { whole, part, unsatisfiable };
  Kind kind = Kind::whole;
  std::uint64_t first = 0, count = 0;

  bool operator==(const ByteRange&) const = default;
};

/// Parses the field Range for a file of `size` bytes. An invalid field, another unit and a list of ranges mean the whole file, as the
/// standard allows. An end beyond the file is clamped.
ByteRange parse_range(std::string_view field, std::uint64_t size);

}  // namespace rgs::view
