// frame_content.cpp - contents of coded frames for decoders elsewhere.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/frame_content.hpp"

#include <algorithm>
#include <cassert>
#include <cstddef>
#include <span>

#include "archive/archive_tables.hpp"
#include "packed/frame_codec.hpp"
#include "packed/inflater.hpp"
#include "rgs/archive_rules.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

std::uint32_t rows_of_frame(const FileView& view, SectionType type, std::uint64_t frame) {
  const FrameTable& table = view.frames(type);
  assert(frame < table.frames.size());
  const std::uint64_t first = frame * table.rows;
  return static_cast<std::uint32_t>(std::min<std::uint64_t>(table.rows, view.header().n_gaussians - first));
}

std::uint64_t frame_content_bytes(const FileView& view, SectionType type, std::uint64_t frame) {
  if (view.archive() != nullptr) return view.frames(type).frames[frame].stored_bytes;
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
    if (view.archive() == nullptr) return inflater_->inflate(*stored, entry.offset, out);
    std::ranges::copy(*stored, out.begin());
    return {};
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

ArchiveRules archive_rules(const FileView& view, std::vector<std::byte>& block) {
  const detail::ArchiveTables& t = *detail::archive_tables(view);
  const ArchiveParameters& p = t.parameters;
  assert(p.codec == Codec::archive);
  block.clear();
  const auto add = [&block](const auto& array) {
    const auto bytes = std::as_bytes(std::span(array));
    const std::size_t at = (block.size() + 15) / 16 * 16;
    block.resize(at + bytes.size());
    std::ranges::copy(bytes, block.begin() + static_cast<std::ptrdiff_t>(at));
    return static_cast<std::uint32_t>(at);
  };
  ArchiveRules rules{};
  rules.shape = p.shape;
  std::ranges::copy(p.centre, rules.centre);
  std::ranges::copy(p.half_width, rules.half_width);
  rules.mean_cells = p.mean_cells, rules.mean_bits = p.mean_bits, rules.opacity_levels = p.opacity_levels;
  rules.n_classes = static_cast<std::uint32_t>(p.classes.size()), rules.n_sh = static_cast<std::uint32_t>(t.n_sh);
  std::ranges::copy(t.dc_centre, rules.dc_centre);
  rules.sh_unit = t.sh_unit;
  std::ranges::copy(t.dc_matrix, rules.dc_matrix);
  rules.dc_smoothing = t.dc_smoothing, rules.sh_smoothing = t.sh_smoothing;
  const detail::ArchiveContexts at = t.contexts();
  const auto context = [](std::size_t first) { return static_cast<std::uint32_t>(first); };
  rules.context = {context(at.opacity), context(at.coarse), context(at.fine),
                   context(at.turn),    context(at.dc),     context(at.sh)};
  std::vector<ArchiveRules::Class> classes;
  for (const ArchiveClass& c : p.classes) {
    classes.push_back({static_cast<std::int32_t>(c.dc_step), static_cast<std::int32_t>(c.sh_units)});
  }
  std::vector<ArchiveRules::Distribution> distributions;
  for (const detail::RansTables::Distribution& d : t.rans.all()) {
    ArchiveRules::Distribution& to = distributions.emplace_back();
    for (std::size_t i = 0; i < to.first.size(); ++i) to.first[i] = d.token[i * to.kSlots];
    to.frequency = d.frequency;
  }
  rules.distributions = add(distributions);
  rules.map = add(t.map);
  rules.classes = add(classes);
  rules.opacities = add(t.opacity);
  rules.sh_matrix = add(t.sh_matrix);
  rules.sh_centre = add(t.sh_centre);
  return rules;
}

}  // namespace rgs
