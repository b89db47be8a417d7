// section_writer.cpp - places sections and writes the head, on disk or in memory.
// SPDX-License-Identifier: Apache-2.0
#include "file/section_writer.hpp"

#include <algorithm>
#include <array>
#include <cassert>

#include "file/checked.hpp"
#include "file/layout_io.hpp"
#include "packed/packed.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

Status Sink::reserve(std::uint64_t size) {
  if (file_ != nullptr) return file_->reserve(size);
  return detail::guard_memory([&]() -> Status {
    memory_->reserve(size);
    return {};
  });
}

Status Sink::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  if (file_ != nullptr) return file_->write_at(offset, bytes);
  if (offset > memory_->max_size() - bytes.size()) return detail::out_of_memory();
  return detail::guard_memory([&]() -> Status {
    if (memory_->size() < offset + bytes.size()) memory_->resize(offset + bytes.size());
    std::ranges::copy(bytes, memory_->begin() + static_cast<std::ptrdiff_t>(offset));
    return {};
  });
}

Status Sink::read_at(std::uint64_t offset, std::span<std::byte> bytes) const {
  if (file_ != nullptr) return file_->read_at(offset, bytes);
  std::ranges::copy(std::span(*memory_).subspan(offset, bytes.size()), bytes.begin());
  return {};
}

Result<std::span<const std::byte>> Sink::view(MappedFile& mapped) const {
  if (file_ == nullptr) return *memory_;
  auto map = MappedFile::map(file_->descriptor());
  if (!map) return tl::unexpected(map.error());
  mapped = *std::move(map);
  return mapped.bytes();
}

Status Sink::truncate(std::uint64_t size) {
  if (file_ != nullptr) return file_->truncate(size);
  return detail::guard_memory([&]() -> Status {
    memory_->resize(size);
    memory_->shrink_to_fit();
    return {};
  });
}

namespace detail {

SectionWriter::SectionWriter(Sink sink, std::span<const SectionEntry> sections, std::uint64_t max_frames)
    : sink_(sink), sections_(sections.size()), end_(section_entry_offset(sections.size()) + kHeadChecksumBytes) {
  largest_file_bytes_ = end_;
  for (std::size_t i = 0; i < sections.size(); ++i) {
    Section& s = sections_[i];
    s.entry = sections[i];
    s.entry.offset = align_up(largest_file_bytes_, kSectionAlignment);
    s.grown_from = s.entry.offset + (s.framed() ? frame_table_bytes(max_frames) : 0);
    largest_file_bytes_ = s.entry.offset + s.entry.stored_bytes;
  }
}

SectionWriter::Section& SectionWriter::find(SectionType type) {
  return *std::ranges::find(sections_, static_cast<std::uint32_t>(type), [](const Section& s) { return s.entry.type; });
}

Status SectionWriter::grow(SectionType type, std::span<const std::byte> bytes, std::uint64_t frame_xxh3) {
  Section& s = find(type);
  assert(s.grown_from + s.grown_bytes + bytes.size() <= s.entry.offset + s.entry.stored_bytes);
  if (Status written = sink_.write_at(s.grown_from + s.grown_bytes, bytes); !written) return written;
  s.grown_bytes += bytes.size();
  if (s.framed()) {
    s.frames.push_back({0, static_cast<std::uint32_t>(bytes.size()), frame_xxh3});
  } else {
    s.hash.update(bytes);
  }
  return {};
}

// Gives the section its offset. Bytes written earlier may lie in the gap before it.
Status SectionWriter::begin(Section& s) {
  static constexpr std::array<std::byte, kSectionAlignment> kZeros{};
  const std::uint64_t offset = align_up(end_, kSectionAlignment);
  assert(offset <= s.entry.offset);
  s.entry.offset = offset;
  return sink_.write_at(end_, std::span(kZeros).first(offset - end_));
}

// Moves a section's frames behind their table. Never downwards, so that nothing is overwritten before it has moved.
Status SectionWriter::move_frames(Section& s) {
  std::uint64_t from = s.grown_from, to = s.entry.offset + s.entry.stored_bytes - s.grown_bytes;
  assert(to <= from);
  std::vector<std::byte> buffer(std::min<std::uint64_t>(s.grown_bytes, std::uint64_t{1} << 20));
  for (std::uint64_t left = s.grown_bytes; left != 0;) {
    const auto part = std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), left));
    if (Status done = sink_.read_at(from, part); !done) return done;
    s.hash.update(part);
    if (Status done = sink_.write_at(to, part); !done) return done;
    from += part.size();
    to += part.size();
    left -= part.size();
  }
  return {};
}

Status SectionWriter::place_grown(SectionType type, std::uint32_t frame_rows) {
  Section& s = find(type);
  if (Status begun = begin(s); !begun) return begun;
  if (s.framed()) {
    const std::vector<std::byte> table = write_frame_table(frame_rows, s.frames);
    s.entry.stored_bytes = table.size() + s.grown_bytes;
    s.hash.update(table);
    if (Status moved = move_frames(s); !moved) return moved;
    if (Status written = sink_.write_at(s.entry.offset, table); !written) return written;
  }
  assert(s.framed() || (s.entry.offset == s.grown_from && s.grown_bytes == s.entry.stored_bytes));
  s.entry.xxh3 = s.hash.digest();
  end_ = s.entry.offset + s.entry.stored_bytes;
  return {};
}

Status SectionWriter::place(SectionType type, std::span<const std::byte> bytes, Codec codec) {
  Section& s = find(type);
  assert(s.grown_bytes == 0 && bytes.size() <= s.entry.stored_bytes);
  if (Status begun = begin(s); !begun) return begun;
  s.entry.codec = static_cast<std::uint32_t>(codec);
  s.entry.stored_bytes = bytes.size();
  s.entry.xxh3 = xxh3(bytes);
  end_ = s.entry.offset + bytes.size();
  return sink_.write_at(s.entry.offset, bytes);
}

Result<std::vector<SectionEntry>> SectionWriter::finish(Header& header) {
  std::vector<SectionEntry> entries;
  for (const Section& s : sections_) entries.push_back(s.entry);
  header.n_sections = static_cast<std::uint32_t>(entries.size());
  header.file_bytes = end_;
  if (const Status s = sink_.truncate(end_); !s) return tl::unexpected(s.error());
  if (const Status s = sink_.write_at(0, write_head(header, entries)); !s) return tl::unexpected(s.error());
  return entries;
}

}  // namespace detail

}  // namespace rgs
