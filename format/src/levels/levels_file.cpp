// levels_file.cpp - sections of a file with levels.
// SPDX-License-Identifier: Apache-2.0
#include "levels/levels_file.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "file/layout_io.hpp"
#include "packed/packed.hpp"

namespace rgs::detail {
namespace {

constexpr std::array<std::byte, kSectionAlignment> kZeros{};

SectionEntry section(SectionType type, std::uint64_t bytes, std::uint32_t flags = kSectionMustUnderstand) {
  SectionEntry entry;
  entry.type = static_cast<std::uint32_t>(type);
  entry.flags = flags;
  entry.stored_bytes = entry.decoded_bytes = bytes;
  return entry;
}

void enlarge(Box& box, const Box& by) {
  for (std::size_t k = 0; k < 3; ++k) {
    box.min[k] = std::min(box.min[k], by.min[k]) + 0.f;  // no -0
    box.max[k] = std::max(box.max[k], by.max[k]) + 0.f;
  }
}

// The nearest FP32 number not above, or not below, a finite value.
float rounded(double value, bool up) {
  constexpr float kMax = std::numeric_limits<float>::max();
  const double limited = std::clamp(value, -static_cast<double>(kMax), static_cast<double>(kMax));
  const auto nearest = static_cast<float>(limited);
  const bool beyond = up ? static_cast<double>(nearest) >= limited : static_cast<double>(nearest) <= limited;
  return beyond ? nearest : std::nextafter(nearest, up ? kMax : -kMax);
}

}  // namespace

void ExtentBox::add(const Extent& e) {
  for (std::size_t k = 0; k < 3; ++k) {
    const double low = e.mean[k] - e.reach[k], high = e.mean[k] + e.reach[k];
    min_[k] = empty_ ? low : std::min(min_[k], low);
    max_[k] = empty_ ? high : std::max(max_[k], high);
  }
  empty_ = false;
}

Box ExtentBox::box() const {
  Box box;
  for (std::size_t k = 0; k < 3; ++k) {
    box.min[k] = rounded(min_[k], false);
    box.max[k] = rounded(max_[k], true);
  }
  return box;
}

std::uint32_t most_chunks(const std::vector<lod::Page>& pages, std::uint32_t chunk_size) {
  std::uint64_t most = 1;
  for (const lod::Page& page : pages) most = std::max(most, chunks_of(page.count, chunk_size));
  return static_cast<std::uint32_t>(most);
}

LevelsFile::LevelsFile(Sink sink, const EncodePlan& plan, PageTable table, std::span<const std::byte> archive)
    : sink_(sink),
      header_(plan.header),
      options_(plan.options),
      table_(std::move(table)),
      archive_(archive.begin(), archive.end()),
      direct_(plan.options.profile == Profile::direct) {
  const std::size_t n = table_.pages.size();
  table_.stored.resize(n);
  table_.n_stored = 0;
  for (const lod::Page& page : table_.pages) table_.n_stored += page.count;
  table_.page_chunks = std::max(most_chunks(table_.pages, header_.chunk_size), table_.page_chunks);
  sections_ = {section(SectionType::declarations, kDeclarationBytes)};
  if (options_.crs != Crs()) sections_.push_back(section(SectionType::crs, write_crs(options_.crs).size(), 0));
  sections_.push_back(section(SectionType::levels, kLevelsHeadBytes + n * kPageRecordBytes));
  if (!archive_.empty()) sections_.push_back(section(SectionType::archive, archive_.size()));
  if (options_.provenance) {
    sections_.push_back(section(SectionType::provenance, write_provenance(*options_.provenance).size(), 0));
  }
  sections_.push_back(section(SectionType::pages, 0));
  sections_.back().codec = static_cast<std::uint32_t>(direct_                               ? Codec::none
                                                      : options_.profile == Profile::packed ? Codec::planes
                                                                                            : Codec::archive);
  if (options_.keep_permutation) sections_.push_back(section(SectionType::permutation, header_.n_gaussians * 4, 0));
  end_ = section_entry_offset(sections_.size()) + kHeadChecksumBytes;
  for (SectionEntry& s : sections_) {
    s.offset = align_up(end_, kSectionAlignment);
    end_ = s.offset + s.stored_bytes;
    if (s.type == static_cast<std::uint32_t>(SectionType::pages)) break;
  }
}

SectionEntry& LevelsFile::entry(SectionType type) {
  return *std::ranges::find(sections_, static_cast<std::uint32_t>(type), &SectionEntry::type);
}

Status LevelsFile::add(const EncodedPage& page) {
  assert(n_added_ < table_.pages.size());
  const std::uint64_t start = direct_ ? align_up(end_, kPageAlignment) : end_;
  const auto padding = std::span(kZeros).first(start - end_);
  if (Status s = sink_.write_at(end_, padding); !s) return s;
  if (Status s = sink_.write_at(start, page.bytes); !s) return s;
  hash_.update(padding);
  hash_.update(page.bytes);
  StoredPage& stored = table_.stored[n_added_];
  stored.offset = start;
  stored.xxh3 = page.xxh3;
  stored.stored_bytes = static_cast<std::uint32_t>(page.bytes.size());
  stored.n_step_sets = page.n_step_sets;
  stored.scale_exponent = page.scale_exponent;
  stored.n_origins = page.n_origins;
  stored.corner = page.corner;
  enlarge(table_.pages[n_added_].bounds, page.extent);
  end_ = start + page.bytes.size();
  ++n_added_;
  return {};
}

Status LevelsFile::place(SectionType type, std::span<const std::byte> bytes) {
  SectionEntry& s = entry(type);
  assert(bytes.size() == s.stored_bytes);
  s.xxh3 = xxh3(bytes);
  return sink_.write_at(s.offset, bytes);
}

Result<WrittenScene> LevelsFile::finish(const Declarations& declarations, std::span<const std::uint32_t> positions) {
  assert(n_added_ == table_.pages.size());
  for (std::size_t i = table_.pages.size(); i-- > 1;) {
    enlarge(table_.pages[table_.pages[i].parent].bounds, table_.pages[i].bounds);
  }
  SectionEntry& pages = entry(SectionType::pages);
  pages.stored_bytes = pages.decoded_bytes = end_ - pages.offset;
  pages.xxh3 = hash_.digest();
  if (!direct_) {
    pages.decoded_bytes = 0;
    for (std::size_t i = 0; i < table_.pages.size(); ++i) {
      pages.decoded_bytes +=
          page_layout(table_.pages[i].count, header_.chunk_size, table_.stored[i].n_step_sets, header_.sh_degree).bytes;
    }
  }
  if (options_.keep_permutation) {
    SectionEntry& s = entry(SectionType::permutation);
    s.offset = align_up(end_, kSectionAlignment);
    if (Status written = sink_.write_at(end_, std::span(kZeros).first(s.offset - end_)); !written)
      return tl::unexpected(written.error());
    end_ = s.offset + s.stored_bytes;
  }
  WrittenScene written{header_, declarations, {}};
  const bool is_new = options_.profile == Profile::archive || options_.crs != Crs() ||
                      options_.first_view != FirstView() ||
                      std::ranges::any_of(table_.stored, [](const StoredPage& page) { return page.n_origins != 0; });
  written.header.version_minor = is_new ? 5 : 4;
  written.header.file_bytes = end_;
  written.header.n_sections = static_cast<std::uint32_t>(sections_.size());
  std::uint64_t before = section_entry_offset(sections_.size()) + kHeadChecksumBytes;
  for (const SectionEntry& section_entry : sections_) {
    const auto type = static_cast<SectionType>(section_entry.type);
    if (before < section_entry.offset && type != SectionType::permutation) {
      if (Status s = sink_.write_at(before, std::span(kZeros).first(section_entry.offset - before)); !s)
        return tl::unexpected(s.error());
    }
    Status s;
    switch (type) {
      case SectionType::declarations: s = place(type, write_declarations(declarations)); break;
      case SectionType::levels: s = place(type, write_page_table(table_)); break;
      case SectionType::archive: s = place(type, archive_); break;
      case SectionType::provenance: s = place(type, write_provenance(*options_.provenance)); break;
      case SectionType::crs: s = place(type, write_crs(options_.crs)); break;
      case SectionType::permutation: s = place(type, std::as_bytes(positions)); break;
      default: break;
    }
    if (!s) return tl::unexpected(s.error());
    before = section_entry.offset + section_entry.stored_bytes;
  }
  if (Status s = sink_.truncate(end_); !s) return tl::unexpected(s.error());
  if (Status s = sink_.write_at(0, write_head(written.header, sections_)); !s) return tl::unexpected(s.error());
  written.sections = sections_;
  return written;
}

}  // namespace rgs::detail
