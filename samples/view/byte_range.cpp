// byte_range.cpp - parses the field Range.
// SPDX-License-Identifier: Apache-2.0
#include "byte_range.hpp"

#include <algorithm>
#include <limits>
#include <optional>
#include <string_view>

namespace rgs::view {
namespace {

// Digits only; numbers that are too large saturate.
std::optional<std::uint64_t> position(std::string_view digits) {
  constexpr std::uint64_t kMost = std::numeric_limits<std::uint64_t>::max();
  if (digits.empty()) return std::nullopt;
  std::uint64_t value = 0;
  for (const char c : digits) {
    if (c < '0' || c > '9') return std::nullopt;
    const auto digit = static_cast<std::uint64_t>(c - '0');
    value = value > (kMost - digit) / 10 ? kMost : 10 * value + digit;
  }
  return value;
}

bool starts_with_bytes(std::string_view field) {
  constexpr std::string_view kUnit = "bytes=";
  return field.size() > kUnit.size() && std::equal(kUnit.begin(), kUnit.end(), field.begin(), [](char unit, char c) {
           return unit == (c >= 'A' && c <= 'Z' ? c - 'A' + 'a' : c);
         });
}

}  // namespace

ByteRange parse_range(std::string_view field, std::uint64_t size) {
  const ByteRange whole{ByteRange::Kind::whole, 0, size};
  if (!starts_with_bytes(field)) return whole;
  field.remove_prefix(field.find('=') + 1);
  const std::size_t begin = field.find_first_not_of(" \t"), end = field.find_last_not_of(" \t");
  if (begin == field.npos) return whole;
  field = field.substr(begin, end + 1 - begin);
  const std::size_t dash = field.find('-');
  if (dash == field.npos) return whole;
  const std::string_view from = field.substr(0, dash), to = field.substr(dash + 1);
  const auto last = position(to);
  if (!last && !to.empty()) return whole;  // several ranges too
  if (from.empty()) {                      // the last bytes
    if (!last) return whole;
    if (*last == 0) return {ByteRange::Kind::unsatisfiable, 0, 0};
    const std::uint64_t count = std::min(*last, size);
    return count == 0 ? whole : ByteRange{ByteRange::Kind::part, size - count, count};
  }
  const auto first = position(from);
  if (!first || (last && *last < *first)) return whole;
  if (*first >= size) return {ByteRange::Kind::unsatisfiable, 0, 0};
  return {ByteRange::Kind::part, *first, std::min(last.value_or(size), size - 1) - *first + 1};
}

}  // namespace rgs::view
