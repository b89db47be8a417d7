// frame_content.hpp - frames of Codec::planes after Zstandard alone, and of Codec::archive as stored, and the checks that
// remain if someone else checks the Gaussians: for readers that decode on a device. docs/format/FORMAT.md "Coded
// sections".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "rgs/decode.hpp"
#include "rgs/planes.hpp"
#include "rgs/stored_values.hpp"

namespace RGS_API rgs {

namespace detail {
class Inflater;
}

/// Rows of frame `frame` of a coded section.
std::uint32_t rows_of_frame(const FileView& view, SectionType type, std::uint64_t frame);
/// Bytes of its content: planes, preceded by weights for SH; the frame itself in an archive.
std::uint64_t frame_content_bytes(const FileView& view, SectionType type, std::uint64_t frame);

/// Reads contents of frames, one at a time, reusing Zstandard's memory.
class FrameContents {
 public:
  FrameContents();
  FrameContents(FrameContents&&) noexcept;
  FrameContents& operator=(FrameContents&&) noexcept;
  ~FrameContents();

  /// Decompresses frame `frame` of a Codec::planes section to `out` [frame_content_bytes()], or copies one of
  /// Codec::archive. Safe on untrusted bytes: any content of planes of that size decodes to some rows. Errors:
  /// checksum_mismatch and, of planes, corrupt_data at the frame's offset, host_out_of_memory.
  Status read(const FileView& view, SectionType type, std::uint64_t frame, std::span<std::byte> out);

 private:
  std::unique_ptr<detail::Inflater> inflater_;
};

/// The steps of each chunk in frame `frame` of SHI8, which decoding its content needs. Errors: those of
/// FileView::chunk_steps(), host_out_of_memory.
Result<std::vector<RelativeShSteps>> relative_sh_steps(const FileView& view, std::uint64_t frame);

/// The checks of validate() other than those of coded frames and of Gaussians' values: hashes of sections stored as is,
/// every entry of the chunk table, the SH steps, the permutation. Errors: those of validate().
Status validate_tables(const FileView& view, unsigned threads = 0);
/// Checks the declarations against the chunk table and the counts of all rows of GEOM. Errors: bad_value.
Status validate_declarations(const FileView& view, const ValueCounts& counts);

}  // namespace rgs
