// frame_content.cpp - contents of coded frames for decoders elsewhere.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/frame_content.hpp"

#include <algorithm>
#include <cassert>

#include "packed/frame_codec.hpp"
#include "packed/inflater.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

std::uint32_t rows_of_frame(const FileView& view, SectionType type, std::uint64_t frame) {
  const FrameTable& table = view.frames(type);
  assert(frame < table.frames.size());
  const std::uint64_t first = frame * table.rows;
  return static_cast<std::uint32_t>(std::min<std::uint64_t>(table.rows, view.header().n_gaussians - first));
}

std::uint64_t frame_content_bytes(const FileView& view, SectionType type, std::uint64_t frame) {
  const std::uint64_t rows = rows_of_frame(view, type, frame);
  switch (type) {
    case SectionType::means: return rows * kMeanBytes;
    case SectionType::geometry: return rows * kGeometryBytes;
    default: {
      assert(type == SectionType::sh);
      const int n_codes = 3 * sh_coefficients(view.header().sh_degree);
      return sh_weight_bytes(n_codes) + rows * static_cast<std::uint64_t>(n_codes);
    }
  }
}

FrameContents::FrameContents() : inflater_(std::make_unique<detail::Inflater>()) {}
FrameContents::FrameContents(FrameContents&&) noexcept = default;
FrameContents& FrameContents::operator=(FrameContents&&) noexcept = default;
FrameContents::~FrameContents() = default;

Status FrameContents::read(const FileView& view, SectionType type, std::uint64_t frame, std::span<std::byte> out) {
  assert(out.size() == frame_content_bytes(view, type, frame));
  return detail::guard_memory([&]() -> Status {
    const auto& entry = view.frames(type).frames[frame];
    const auto stored = detail::frame_bytes(view, entry);
    if (!stored) return tl::unexpected(stored.error());
    return inflater_->inflate(*stored, entry.offset, out);
  });
}

Result<std::vector<RelativeShSteps>> relative_sh_steps(const FileView& view, std::uint64_t frame) {
  return detail::guard_memory([&]() -> Result<std::vector<RelativeShSteps>> {
    const std::uint32_t chunk_rows = view.header().chunk_size;
    const std::uint64_t first = frame * view.frames(SectionType::sh).rows / chunk_rows;
    const std::uint64_t count = (rows_of_frame(view, SectionType::sh, frame) + chunk_rows - 1) / chunk_rows;
    std::vector<ShStepSet> steps;
    if (const Status s = detail::frame_steps(view, first, count, steps); !s) return tl::unexpected(s.error());
    return detail::relative_sh_steps({view.header().sh_degree, chunk_rows, steps});
  });
}

}  // namespace rgs
