// archive_edits.hpp - changes of the frames and of section ARCH of an archive, whose last section ARCH is.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <zstd.h>

#include <utility>

#include "edit_file.hpp"

namespace rgs::test::detail {

inline constexpr std::uint64_t kFrameTable = 32;  ///< bytes of the table of a section's only frame

/// The only frame of the section of `type`.
inline Bytes frame_of(const Bytes& b, std::string_view type) {
  const auto first = b.begin() + static_cast<std::ptrdiff_t>(section_of(b, type) + kFrameTable);
  return {first, first + get<std::uint32_t>(b, section_of(b, type) + 16)};
}

/// Replaces it; sections behind move along.
inline void set_frame(Bytes& b, std::string_view type, std::span<const std::byte> frame) {
  const auto aligned = [](std::uint64_t x) { return (x + 255) / 256 * 256; };
  const std::uint64_t entry = entry_of(b, type), at = section_of(b, type), size = kFrameTable + frame.size();
  const std::uint64_t behind = aligned(at + get<std::uint64_t>(b, entry + 24)), now = aligned(at + size);
  Bytes out(b.begin(), b.begin() + static_cast<std::ptrdiff_t>(at + kFrameTable));
  out.insert(out.end(), frame.begin(), frame.end());
  out.resize(now);
  out.insert(out.end(), b.begin() + static_cast<std::ptrdiff_t>(behind), b.end());
  put(out, 16, std::uint64_t{out.size()});
  put(out, entry + 24, size);
  put(out, at + 16, static_cast<std::uint32_t>(frame.size()));
  for (std::uint64_t i = 0; i < get<std::uint32_t>(out, 52); ++i) {
    const auto offset = get<std::uint64_t>(out, entry_at(i) + 16);
    if (offset > at) put(out, entry_at(i) + 16, offset - behind + now);
  }
  b = std::move(out);
}

/// Grows the section of table entry `entry` and its only frame, over the zeros behind it.
inline void grow_frame(Bytes& b, std::uint64_t entry, std::uint32_t bytes) {
  const auto section = get<std::uint64_t>(b, entry + 16);
  put(b, entry + 24, get<std::uint64_t>(b, entry + 24) + bytes);
  put(b, section + 16, get<std::uint32_t>(b, section + 16) + bytes);
}

/// Truncates the file, and its section ARCH, to `bytes` of the section.
inline void end_parameters(Bytes& b, std::uint64_t bytes) {
  const std::uint64_t entry = entry_of(b, "ARCH");
  b.resize(section_of(b, "ARCH") + bytes);
  put(b, 16, std::uint64_t{b.size()});
  put(b, entry + 24, bytes);
  put(b, entry + 32, bytes);
}

/// Changes the content of the Zstandard frame from `at` to the end of the file.
template <class Change>
void change_tables(Bytes& b, std::uint64_t at, Change change) {
  Bytes tables(ZSTD_getFrameContentSize(b.data() + at, b.size() - at));
  ZSTD_decompress(tables.data(), tables.size(), b.data() + at, b.size() - at);
  change(tables);
  b.resize(at + ZSTD_compressBound(tables.size()));
  b.resize(at + ZSTD_compress(b.data() + at, b.size() - at, tables.data(), tables.size(), 1));
  end_parameters(b, b.size() - section_of(b, "ARCH"));
}

}  // namespace rgs::test::detail
