// section_writer.hpp - head, section table and sections of a file, wherever their contents come from.
//
// The size of a coded section is unknown before its last frame. So growing sections are written where they would start
// if all sections before them had their largest sizes; once all are complete, every section is placed behind the one
// before it, and its bytes move up.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/checksum.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_writer.hpp"

namespace rgs::detail {

/// All functions return the errors of their sink.
class SectionWriter {
 public:
  /// Sections in file order; stored_bytes: upper bounds, with the table of at most `max_frames` frames if coded.
  SectionWriter(Sink sink, std::span<const SectionEntry> sections, std::uint64_t max_frames);
  /// File size if all sections have their largest sizes.
  std::uint64_t largest_file_bytes() const { return largest_file_bytes_; }

  /// Appends bytes to a section; if its codec has frames, the next frame, which needs its hash.
  Status grow(SectionType type, std::span<const std::byte> bytes, std::uint64_t frame_xxh3 = 0);
  /// Once all have grown, places sections in file order: one that has grown (`frame_rows`: rows a frame),
  Status place_grown(SectionType type, std::uint32_t frame_rows);
  /// or one with these stored bytes.
  Status place(SectionType type, std::span<const std::byte> bytes, Codec codec = Codec::none);
  /// Writes the end of the file, then its head. Returns the section table.
  Result<std::vector<SectionEntry>> finish(Header& header);

 private:
  struct Section {
    SectionEntry entry;
    std::uint64_t grown_from = 0, grown_bytes = 0;  // before its final place is known
    bool framed() const { return entry.codec != static_cast<std::uint32_t>(Codec::none); }
    Hasher hash;                     // of the stored bytes, as they become final
    std::vector<CodedFrame> frames;  // without offsets
  };
  Section& find(SectionType type);
  Status begin(Section& section);
  Status move_frames(Section& section);

  Sink sink_;
  std::vector<Section> sections_;
  std::uint64_t largest_file_bytes_ = 0;
  std::uint64_t end_ = 0;  // of the last placed section
};

}  // namespace rgs::detail
