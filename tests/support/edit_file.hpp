// edit_file.hpp - edits .rgs files byte by byte and corrects their hashes. It has its own description of the layout, so
// that the library does not check itself.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/checksum.hpp"

namespace rgs::test {

using Bytes = std::vector<std::byte>;

inline Bytes read_bytes(const std::filesystem::path& path) {
  std::ifstream in(path, std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(in), {}};
  if (!in) throw std::runtime_error("cannot read " + path.string());
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}

template <class T>
T get(std::span<const std::byte> bytes, std::uint64_t at) {
  T value;
  if (at > bytes.size() || sizeof value > bytes.size() - at) throw std::out_of_range("get");
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

template <class T>
void put(std::span<std::byte> bytes, std::uint64_t at, T value) {
  if (at > bytes.size() || sizeof value > bytes.size() - at) throw std::out_of_range("put");
  std::memcpy(bytes.data() + at, &value, sizeof value);
}

inline std::uint64_t entry_at(std::uint64_t index) {
  return 128 + 64 * index;
}

/// Offset of the table entry of `type`, e.g. "MEAN".
inline std::uint64_t entry_of(std::span<const std::byte> file, std::string_view type) {
  for (std::uint64_t i = 0; i < get<std::uint32_t>(file, 52); ++i) {
    if (std::memcmp(file.data() + entry_at(i), type.data(), 4) == 0) return entry_at(i);
  }
  throw std::out_of_range("no such section");
}

/// Offset of the section of `type`.
inline std::uint64_t section_of(std::span<const std::byte> file, std::string_view type) {
  return get<std::uint64_t>(file, entry_of(file, type) + 16);
}

/// Recomputes the hashes of a coded section's frames and frame table, as far as they exist.
inline void fix_frame_hashes(std::span<std::byte> section) {
  if (section.size() < 16) return;
  const std::uint64_t n = get<std::uint32_t>(section, 4), table = 8 + 16 * n;
  if (table > section.size() - 8) return;
  std::uint64_t at = table + 8;
  for (std::uint64_t i = 0; i < n; ++i) {
    const std::uint64_t size = get<std::uint32_t>(section, 16 + 16 * i);
    if (size > section.size() - at) break;
    put(section, 8 + 16 * i, xxh3(section.subspan(at, size)));
    at += size;
  }
  put(section, table, xxh3(section.first(table)));
}

/// Recomputes the hashes of pages in section LODS, as far as they exist.
inline void fix_page_hashes(std::span<std::byte> file, std::uint64_t levels, std::uint64_t levels_bytes) {
  if (levels_bytes < 64) return;
  const std::uint64_t n = get<std::uint32_t>(file, levels);
  for (std::uint64_t i = 0; i < n && i < (levels_bytes - 64) / 112; ++i) {
    const std::uint64_t record = levels + 64 + 112 * i;
    const auto offset = get<std::uint64_t>(file, record), size = std::uint64_t{get<std::uint32_t>(file, record + 16)};
    if (offset > file.size() || size > file.size() - offset) continue;
    put(file, record + 8, xxh3(file.subspan(offset, size)));
  }
}

enum class Hashes { all, but_frames };

/// Recomputes the hash of each section (after its frames' and pages'), then that of the head, as far as they exist.
/// Safe on any bytes.
inline void fix_hashes(std::span<std::byte> file, Hashes which = Hashes::all) {
  if (file.size() < 128) return;
  const std::uint64_t n = get<std::uint32_t>(file, 52);
  if (n > (file.size() - 128) / 64) return;
  for (std::uint64_t i = 0; i < n; ++i) {
    const auto offset = get<std::uint64_t>(file, entry_at(i) + 16), size = get<std::uint64_t>(file, entry_at(i) + 24);
    if (offset > file.size() || size > file.size() - offset) continue;
    const auto codec = get<std::uint32_t>(file, entry_at(i) + 8);
    const bool levels = std::memcmp(file.data() + entry_at(i), "LODS", 4) == 0;
    const bool pages = std::memcmp(file.data() + entry_at(i), "PAGE", 4) == 0;
    if (which == Hashes::all && levels) fix_page_hashes(file, offset, size);
    if (which == Hashes::all && !pages && codec >= 1 && codec <= 3) fix_frame_hashes(file.subspan(offset, size));
    put(file, entry_at(i) + 40, xxh3(file.subspan(offset, size)));
  }
  if (file.size() - entry_at(n) >= 8) put(file, entry_at(n), xxh3(file.first(entry_at(n))));
}

/// A copy with correct hashes and, mostly, size: fuzz targets read it too, since checksums stop every mutation.
inline Bytes repaired(std::span<const std::byte> bytes) {
  Bytes file(bytes.begin(), bytes.end());
  const std::uint64_t size = file.size();
  if (size >= 24 && size % 8 != 0) put(std::span(file), 16, size);  // otherwise the end may be missing
  fix_hashes(file);
  return file;
}

}  // namespace rgs::test
