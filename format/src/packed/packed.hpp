// packed.hpp - sections with a frame table, as stored.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/layout.hpp"

namespace rgs::detail {

/// The bytes before a section's frames; the frames' offsets are ignored.
std::vector<std::byte> write_frame_table(std::uint32_t rows, std::span<const CodedFrame> frames);
constexpr std::uint64_t frame_table_bytes(std::uint64_t n_frames) {
  return kFrameTableBytes + n_frames * kFrameEntryBytes + 8;
}

/// A table of 48-byte records as a coded section, or uncoded if that is no larger.
struct StoredTable {
  std::vector<std::byte> bytes;
  Codec codec = Codec::none;
};
StoredTable code_table(std::vector<std::byte> records, int level);

/// Largest section of Codec::planes, table included: noise is stored uncompressed, with Zstandard's headers and ours.
constexpr std::uint64_t coded_bound(std::uint64_t decoded_bytes, std::uint64_t n_frames) {
  return decoded_bytes + decoded_bytes / 128 + 4096 * n_frames + 64;
}

}  // namespace rgs::detail
