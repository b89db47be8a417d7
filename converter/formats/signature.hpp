// signature.hpp - by what formats are recognised: first bytes, a key of JSON, a name in a zip archive.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <span>
#include <string_view>

namespace rgs::detail {

inline std::string_view text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

inline bool begins_with(std::span<const std::byte> bytes, std::string_view magic) {
  return text_of(bytes).starts_with(magic);
}

/// Whether a JSON object names `key` in its first 64 KiB.
inline bool is_json_with(std::span<const std::byte> bytes, std::string_view key) {
  const std::string_view text = text_of(bytes).substr(0, 65536);
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  return first != text.npos && text[first] == '{' && text.find(key) != text.npos;
}

inline bool is_zip(std::span<const std::byte> bytes) {
  return begins_with(bytes, "PK\x03\x04") || begins_with(bytes, "PK\x05\x06");
}

/// Whether the first or the last names of a zip archive hold `part`.
inline bool is_zip_with(std::span<const std::byte> bytes, std::string_view part) {
  constexpr std::size_t kFirstName = 30, kLastNames = 256;
  const std::string_view text = text_of(bytes);
  if (!is_zip(bytes) || text.size() < kFirstName) return false;
  const std::size_t name_bytes = std::to_integer<std::size_t>(bytes[26]) | std::to_integer<std::size_t>(bytes[27]) << 8;
  return text.substr(kFirstName, name_bytes).find(part) != text.npos ||
         text.substr(text.size() - std::min(text.size(), kLastNames)).find(part) != text.npos;
}

}  // namespace rgs::detail
