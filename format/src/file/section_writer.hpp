// section_writer.hpp - head, section table and sections of a file, wherever their contents come from.
//
// A section that is coded has a size that nobody knows before its last frame is there. So sections that grow do so where
// they would begin if all before them had their largest sizes; once all have grown, every section is placed behind the one
// before it, and what had grown moves up.
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

/// All functions give the errors of their sink.
class SectionWriter {
 public:
  /// Sections in file order; stored_bytes: the most that each can take, with the table of at most `max_frames` frames
  /// where it has a codec.
  SectionWriter(Sink sink, std::span<const SectionEntry> sections, std::uint64_t max_frames);
  /// The file if all sections have their largest sizes.
  std::uint64_t largest_file_bytes() const { return largest_file_bytes_; }

  /// More bytes of a section; the next frame if its codec has frames, which then need their own hash.
  Status grow(SectionType type, std::span<const std::byte> bytes, std::uint64_t frame_xxh3 = 0);
  /// Once all have grown, sections are placed in file order: one that has grown (`frame_rows`: rows a frame),
  Status place_grown(SectionType type, std::uint32_t frame_rows);
  /// or one whose stored bytes are these.
  Status place(SectionType type, std::span<const std::byte> bytes, Codec codec = Codec::none);
  /// The end of the file, and its beginning. Returns the section table.
  Result<std::vector<SectionEntry>> finish(Header& header);

 private:
  struct Section {
    SectionEntry entry;
    std::uint64_t grown_from = 0, grown_bytes = 0;  // before its place is known
    bool framed() const { return entry.codec != static_cast<std::uint32_t>(Codec::none); }
    Hasher hash;                     // of the stored bytes, as they become known
    std::vector<CodedFrame> frames;  // without offsets
  };
  Section& find(SectionType type);
  Status begin(Section& section);
  Status move_frames(Section& section);

  Sink sink_;
  std::vector<Section> sections_;
  std::uint64_t largest_file_bytes_ = 0;
  std::uint64_t end_ = 0;  // of the last section that has its place
};

}  // namespace rgs::detail
