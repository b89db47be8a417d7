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

/// What the field Range asks of `size` bytes. A field that is no range of bytes (another unit, the last before the first) and one that
/// lists several stand for the whole, as the standard allows. Ends beyond the file are its end, however large the number.
ByteRange parse_range(std::string_view field, std::uint64_t size);

}  // namespace rgs::view
