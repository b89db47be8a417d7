// made_bytes.hpp - files whose bytes follow from their offsets, so that any part can be checked without a copy.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <fstream>
#include <string>
#include <vector>

namespace rgs::test {

/// The same bytes as hostile_server.py's.
inline std::byte byte_at(std::uint64_t offset) {
  return static_cast<std::byte>((offset * 2654435761u) >> 13);
}

inline bool are_bytes_from(std::uint64_t offset, const std::vector<std::byte>& bytes) {
  for (std::uint64_t i = 0; i < bytes.size(); ++i) {
    if (bytes[i] != byte_at(offset + i)) return false;
  }
  return true;
}

inline void write_bytes(const std::string& path, std::uint64_t n) {
  std::string text(n, '\0');
  for (std::uint64_t i = 0; i < n; ++i) text[i] = static_cast<char>(byte_at(i));
  std::ofstream(path, std::ios::binary) << text;
}

}  // namespace rgs::test
