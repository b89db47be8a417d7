// layout_io.hpp - serialises and parses header, section table and fixed records. Parsing checks single fields; open.cpp
// checks fields against each other.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "file/byte_reader.hpp"
#include "file/byte_writer.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Offset of entry `i` of the section table in the file.
constexpr std::uint64_t section_entry_offset(std::uint64_t i) {
  return kHeaderBytes + i * kSectionEntryBytes;
}

/// Header, table and their checksum: kHeaderBytes + n * kSectionEntryBytes + kHeadChecksumBytes.
std::vector<std::byte> write_head(const Header& header, std::span<const SectionEntry> sections);
std::vector<std::byte> write_declarations(const Declarations& declarations);
void write_chunk_entry(ByteWriter& out, const ChunkEntry& entry);
void write_step_set(ByteWriter& out, const ShStepSet& set);
std::vector<std::byte> write_provenance(const Provenance& provenance);
std::vector<std::byte> write_crs(const Crs& crs);

/// The first kHeaderBytes of a file.
Result<Header> parse_header(std::span<const std::byte> bytes);
Result<SectionEntry> parse_section_entry(std::span<const std::byte> bytes, std::uint64_t offset);
/// `offset`: of the record in the file.
Result<Declarations> parse_declarations(std::span<const std::byte> bytes, std::uint64_t offset, std::uint16_t minor);
Result<ChunkEntry> parse_chunk_entry(std::span<const std::byte> bytes, std::uint64_t offset);
ShStepSet parse_step_set(std::span<const std::byte> bytes);
Result<Provenance> parse_provenance(std::span<const std::byte> bytes, std::uint64_t offset);
/// `axes`: of the scene. `bytes`: of a size that open() accepts.
Result<Crs> parse_crs(std::span<const std::byte> bytes, std::uint64_t offset, const std::array<Axis, 3>& axes);

}  // namespace rgs::detail
