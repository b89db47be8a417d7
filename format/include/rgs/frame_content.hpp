// frame_content.hpp - frames of Codec::planes with their Zstandard undone and nothing else, and the checks that are left
// when somebody else checks the Gaussians: for readers that decode on a device. docs/format/FORMAT.md "Coded sections".
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
/// Bytes of its content: planes, for SH weights before them.
std::uint64_t frame_content_bytes(const FileView& view, SectionType type, std::uint64_t frame);

/// Reads contents of frames, one at a time. Keeps Zstandard's memory from one to the next.
class FrameContents {
 public:
  FrameContents();
  FrameContents(FrameContents&&) noexcept;
  FrameContents& operator=(FrameContents&&) noexcept;
  ~FrameContents();

  /// The content of frame `frame` of a section of Codec::planes to `out` [frame_content_bytes()]. Safe on untrusted
  /// bytes: any content of that size decodes to some rows. Errors: checksum_mismatch and corrupt_data at the frame's
  /// place in the file, host_out_of_memory.
  Status read(const FileView& view, SectionType type, std::uint64_t frame, std::span<std::byte> out);

 private:
  std::unique_ptr<detail::Inflater> inflater_;
};

/// What decoding frame `frame` of SHI8 needs besides its content: the steps of each chunk that it touches. Errors: those
/// of FileView::chunk_steps(), host_out_of_memory.
Result<std::vector<RelativeShSteps>> relative_sh_steps(const FileView& view, std::uint64_t frame);

/// What validate() checks of a file but for its coded frames, the Gaussians' values with what the chunk table and the
/// declarations state of them: hashes of what is stored as is, every entry of the chunk table, the SH steps, the
/// permutation. Errors: those of validate().
Status validate_tables(const FileView& view, unsigned threads = 0);
/// The declarations against the chunk table and what all rows of GEOM have been counted to hold. Errors: bad_value.
Status validate_declarations(const FileView& view, const ValueCounts& counts);

}  // namespace rgs
