// checked.hpp - 64-bit size arithmetic that detects overflow.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace rgs::detail {

/// a * b, or false on overflow.
inline bool multiply(std::uint64_t a, std::uint64_t b, std::uint64_t& product) {
  return !__builtin_mul_overflow(a, b, &product);
}

/// Next multiple of `alignment` (a power of two); `value` must be at most 2^64 - alignment.
constexpr std::uint64_t align_up(std::uint64_t value, std::uint64_t alignment) {
  return (value + alignment - 1) & ~(alignment - 1);
}

}  // namespace rgs::detail
