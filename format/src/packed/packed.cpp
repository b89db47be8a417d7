// packed.cpp - coded sections and where they lie in the file.
// SPDX-License-Identifier: Apache-2.0
#include "packed/packed.hpp"

#include <algorithm>
#include <cassert>

#include "file/byte_writer.hpp"
#include "file/checked.hpp"
#include "file/layout_io.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"

namespace rgs {
namespace {

std::vector<std::byte> write_frame_table(std::uint32_t rows, std::span<const CodedFrame> frames) {
  detail::ByteWriter out;
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

std::uint64_t total_bytes(std::span<const CodedFrame> frames) {
  std::uint64_t bytes = 0;
  for (const CodedFrame& frame : frames) bytes += frame.stored_bytes;
  return bytes;
}

// A table of 48-byte records as a coded section, unless that is no smaller.
std::vector<std::byte> code_table(std::vector<std::byte> records, int level, SectionEntry& entry) {
  static_assert(kChunkEntryBytes == kStepSetBytes);
  constexpr std::uint32_t kRows = 16384;
  detail::FrameEncoder encoder(level);
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
  if (section.size() >= records.size()) return records;
  entry.codec = static_cast<std::uint32_t>(Codec::planes);
  return section;
}

}  // namespace

struct PackedEncoder::State {
  const EncodePlan* plan;
  detail::FrameEncoder frames;
};

PackedEncoder::PackedEncoder(const EncodePlan& plan)
    : state_(std::make_unique<State>(State{&plan, detail::FrameEncoder(plan.level)})) {}
PackedEncoder::PackedEncoder(PackedEncoder&& other) noexcept = default;
PackedEncoder::~PackedEncoder() = default;

PackedFrames PackedEncoder::encode(std::span<const std::byte> means, std::span<const std::byte> geometry,
                                   std::span<const std::byte> sh, std::span<const ShStepSet> scales) {
  const Header& h = state_->plan->header;
  assert(means.size() <= state_->plan->frame_rows() * kMeanBytes);
  return {state_->frames.words(means, kMeanBytes), state_->frames.geometry(geometry),
          state_->frames.sh(sh, {h.sh_degree, h.chunk_size, scales})};
}

SectionEntry& PackedLayout::find(SectionType type) {
  return *std::ranges::find(sections, static_cast<std::uint32_t>(type), &SectionEntry::type);
}

std::span<const std::byte> PackedLayout::table(SectionType type) {
  // Sections without bytes begin where the next one does; the table is the last piece there.
  return std::find_if(pieces.rbegin(), pieces.rend(),
                      [at = find(type).offset](const FilePiece& piece) { return piece.offset == at; })
      ->bytes;
}

FilePiece PackedLayout::head() const {
  return {0, detail::write_head(header, sections)};
}

PackedLayout finish_packed(const EncodePlan& plan, std::span<const ChunkEntry> chunks,
                           std::span<const ShStepSet> scales, const EncodeCounts& counts,
                           const PackedSections& frames) {
  assert(plan.profile != Profile::direct);
  const bool archive = plan.profile == Profile::archive;
  PackedLayout layout;
  layout.header = plan.header;
  layout.header.version_minor = archive ? 2 : 1;
  layout.sections = plan.sections;
  std::uint64_t end = kHeaderBytes + plan.header.n_sections * kSectionEntryBytes + kHeadChecksumBytes;
  for (SectionEntry& entry : layout.sections) {
    const auto type = static_cast<SectionType>(entry.type);
    entry.offset = detail::align_up(end, kSectionAlignment);
    const std::vector<CodedFrame>* list = type == SectionType::means      ? &frames.means
                                          : type == SectionType::geometry ? &frames.geometry
                                          : type == SectionType::sh       ? &frames.sh
                                                                          : nullptr;
    if (list != nullptr) {
      auto table = write_frame_table(plan.frame_rows(), *list);
      entry.codec = static_cast<std::uint32_t>(archive ? Codec::archive : Codec::planes);
      entry.stored_bytes = table.size() + total_bytes(*list);
      layout.pieces.push_back({entry.offset, std::move(table)});
    } else if (type != SectionType::permutation) {
      auto bytes = type == SectionType::archive ? frames.archive_tables
                                                : detail::small_section(plan, type, chunks, scales, counts);
      if (type == SectionType::archive) entry.decoded_bytes = bytes.size();
      if (coded_type(type)) bytes = code_table(std::move(bytes), plan.level, entry);
      entry.stored_bytes = bytes.size();
      entry.xxh3 = xxh3(bytes);
      layout.pieces.push_back({entry.offset, std::move(bytes)});
    }
    end = entry.offset + entry.stored_bytes;
  }
  layout.header.file_bytes = end;
  return layout;
}

namespace detail {

void FrameBytes::append(std::span<const std::byte> frame) {
  frames.push_back({bytes.size(), static_cast<std::uint32_t>(frame.size()), xxh3(frame)});
  bytes.insert(bytes.end(), frame.begin(), frame.end());
}

std::vector<std::byte> assemble_frames(const EncodePlan& plan, FramedFile parts) {
  PackedSections sections{std::move(parts.means.frames),
                          std::move(parts.geometry.frames),
                          std::move(parts.sh.frames),
                          {parts.tables.begin(), parts.tables.end()}};
  PackedLayout layout = finish_packed(plan, parts.chunks, parts.scales, parts.counts, sections);
  std::vector<std::byte> file(layout.header.file_bytes);
  const auto put = [&file](std::uint64_t offset, std::span<const std::byte> bytes) {
    std::ranges::copy(bytes, file.begin() + static_cast<std::ptrdiff_t>(offset));
  };
  for (const FilePiece& piece : layout.pieces) put(piece.offset, piece.bytes);
  const auto place = [&](SectionType type, std::span<const std::byte> frames) {
    SectionEntry& entry = layout.find(type);
    put(entry.offset + entry.stored_bytes - frames.size(), frames);
    entry.xxh3 = xxh3(std::span(file).subspan(entry.offset, entry.stored_bytes));
  };
  place(SectionType::means, parts.means.bytes);
  place(SectionType::geometry, parts.geometry.bytes);
  place(SectionType::sh, parts.sh.bytes);
  if (plan.keep_permutation) place(SectionType::permutation, parts.permutation);
  put(0, layout.head().bytes);
  return file;
}

}  // namespace detail

}  // namespace rgs
