// packed.cpp - writes frame tables, and small tables as coded sections.
// SPDX-License-Identifier: Apache-2.0
#include "packed/packed.hpp"

#include <algorithm>

#include "file/byte_writer.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"

namespace rgs::detail {

std::vector<std::byte> write_frame_table(std::uint32_t rows, std::span<const CodedFrame> frames) {
  ByteWriter out;
  out.u32(rows);
  out.u32(static_cast<std::uint32_t>(frames.size()));
  for (const CodedFrame& frame : frames) {
    out.u64(frame.xxh3);
    out.u32(frame.stored_bytes);
    out.u32(0);
  }
  out.u64(xxh3(out.bytes()));
  return out.take();
}

StoredTable code_table(std::vector<std::byte> records, int level) {
  static_assert(kChunkEntryBytes == kStepSetBytes);
  constexpr std::uint32_t kRows = 16384;
  FrameEncoder encoder(level);
  std::vector<CodedFrame> frames;
  std::vector<std::byte> stored;
  for (std::size_t first = 0; first < records.size(); first += kRows * kChunkEntryBytes) {
    const std::size_t count = std::min<std::size_t>(kRows * kChunkEntryBytes, records.size() - first);
    const auto frame = encoder.words(std::span(records).subspan(first, count), kChunkEntryBytes);
    frames.push_back({0, static_cast<std::uint32_t>(frame.size()), xxh3(frame)});
    stored.insert(stored.end(), frame.begin(), frame.end());
  }
  std::vector<std::byte> section = write_frame_table(kRows, frames);
  section.insert(section.end(), stored.begin(), stored.end());
  if (section.size() >= records.size()) return {std::move(records)};
  return {std::move(section), Codec::planes};
}

}  // namespace rgs::detail
