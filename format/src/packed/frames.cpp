// frames.cpp - frame tables of coded sections, and the small sections that FileView::open() decodes.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cassert>
#include <limits>

#include "archive/archive_tables.hpp"
#include "file/checked.hpp"
#include "file/layout_io.hpp"
#include "packed/frame_codec.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"

namespace rgs {
namespace {

std::uint64_t row_bytes(SectionType type, int sh_degree) {
  switch (type) {
    case SectionType::sh_steps: return kStepSetBytes;
    case SectionType::chunks: return kChunkEntryBytes;
    case SectionType::means: return kMeanBytes;
    case SectionType::geometry: return kGeometryBytes;
    case SectionType::sh: return sh_bytes(sh_degree);
    default: return 1;
  }
}

// Parses the table at the start of a coded section of `n` rows.
Result<FrameTable> parse_frame_table(std::span<const std::byte> bytes, const SectionEntry& s, std::uint64_t n,
                                     std::uint32_t rows_multiple) {
  detail::ByteReader in(bytes, s.offset);
  FrameTable table;
  table.rows = in.u32();
  const std::uint32_t n_frames = in.u32();
  if (!in.ok()) return make_error(Errc::size_mismatch, s.offset, "a coded section ends inside its frame table");
  const std::uint32_t most = s.codec == static_cast<std::uint32_t>(Codec::archive) ? kMaxArchiveRows : kMaxFrameRows;
  if (table.rows > most) {
    return make_error(Errc::bad_value, s.offset, "more rows a frame than its codec allows", most, table.rows);
  }
  if (table.rows == 0 || table.rows % rows_multiple != 0) {
    return make_error(Errc::bad_value, s.offset, "rows a frame are not whole chunks", rows_multiple, table.rows);
  }
  const std::uint64_t expected = n / table.rows + (n % table.rows != 0 ? 1 : 0);
  if (n_frames != expected) {
    return make_error(Errc::bad_value, s.offset + 4, "the number of frames contradicts that of rows", expected,
                      n_frames);
  }
  if (in.remaining() < n_frames * kFrameEntryBytes + kHeadChecksumBytes) {
    return make_error(Errc::size_mismatch, s.offset, "a coded section ends inside its frame table");
  }
  const std::uint64_t table_bytes = kFrameTableBytes + n_frames * kFrameEntryBytes;
  std::uint64_t at = s.offset + table_bytes + kHeadChecksumBytes;
  const std::uint64_t end = s.offset + s.stored_bytes;
  table.frames.reserve(n_frames);
  for (std::uint32_t i = 0; i < n_frames; ++i) {
    CodedFrame frame;
    frame.offset = at;
    frame.xxh3 = in.u64();
    frame.stored_bytes = in.u32();
    if (in.u32() != 0)
      return make_error(Errc::reserved_bits, in.offset() - 4, "a reserved field of a frame entry is set");
    if (frame.stored_bytes > end - at) {
      return make_error(Errc::size_mismatch, in.offset() - 8, "a frame reaches beyond its section", end - at,
                        frame.stored_bytes);
    }
    at += frame.stored_bytes;
    table.frames.push_back(frame);
  }
  const std::uint64_t stored = in.u64(), hash = xxh3(bytes.first(table_bytes));
  if (stored != hash) {
    return make_error(Errc::checksum_mismatch, s.offset + table_bytes, "the checksum of a frame table does not match",
                      stored, hash);
  }
  if (at != end) return make_error(Errc::size_mismatch, at, "bytes after the last frame of a section", end, at);
  return table;
}

Result<std::vector<std::byte>> decode_table(const FileView& view, SectionType type) {
  const SectionEntry& s = *view.find(type);
  const FrameTable& table = view.frames(type);
  const std::uint64_t bytes = row_bytes(type, 0), n = s.decoded_bytes / bytes;
  std::vector<std::byte> out(s.decoded_bytes);
  detail::FrameDecoder decoder;
  for (std::size_t i = 0; i < table.frames.size(); ++i) {
    const CodedFrame& frame = table.frames[i];
    const auto stored = view.bytes().subspan(frame.offset, frame.stored_bytes);
    if (const std::uint64_t hash = xxh3(stored); hash != frame.xxh3) {
      return make_error(Errc::checksum_mismatch, frame.offset, "a frame's checksum does not match", frame.xxh3, hash);
    }
    const std::uint64_t first = i * std::uint64_t{table.rows}, count = std::min<std::uint64_t>(table.rows, n - first);
    if (const Status ok = decoder.words(stored, frame.offset, static_cast<std::uint32_t>(count), bytes,
                                        std::span(out).subspan(first * bytes, count * bytes));
        !ok) {
      return tl::unexpected(ok.error());
    }
  }
  return out;
}

}  // namespace

const FrameTable& FileView::frames(SectionType type) const {
  static const FrameTable kNone;
  const SectionEntry* entry = find(type);
  return entry == nullptr || frames_.empty() ? kNone : frames_[static_cast<std::size_t>(entry - sections_.data())];
}

bool FileView::coded() const {
  return !frames_.empty();
}

std::uint64_t FileView::place(SectionType type, std::uint64_t row, std::uint64_t byte) const {
  const FrameTable& table = frames(type);
  if (!table.frames.empty()) return table.frames[row / table.rows].offset;
  return find(type)->offset + row * row_bytes(type, header_.sh_degree) + byte;
}

std::span<const std::byte> FileView::table(SectionType type) const {
  if (frames(type).rows == 0) return stored(type);
  return type == SectionType::chunks ? tables_->chunks : tables_->scales;
}

const ArchiveParameters* FileView::archive() const {
  return archive_ ? &archive_->parameters : nullptr;
}

namespace detail {

const ArchiveTables* archive_tables(const FileView& view) {
  return view.archive_.get();
}

}  // namespace detail

Status FileView::open_archive(std::span<const std::byte> bytes) {
  const SectionEntry* entry = find(SectionType::archive);
  if (entry == nullptr || header_.version_minor < 2) return {};
  const std::uint32_t rows = frames(SectionType::means).rows;  // 0 if the Gaussians are in pages
  for (const SectionType type : {SectionType::geometry, SectionType::sh}) {
    if (frames(type).rows != rows) {
      return make_error(Errc::bad_value, find(type)->offset, "frames of MEAN, GEOM and SHI8 differ in rows", rows,
                        frames(type).rows);
    }
  }
  if (const std::uint64_t hash = xxh3(bytes); hash != entry->xxh3) {
    return make_error(Errc::checksum_mismatch, entry->offset, "a section's checksum does not match", entry->xxh3, hash);
  }
  const SectionEntry* coded = find(SectionType::geometry);
  if (coded == nullptr) coded = find(SectionType::pages);
  auto parsed = detail::parse_archive_tables(bytes, entry->offset, static_cast<Codec>(coded->codec), header_.sh_degree);
  if (!parsed) return tl::unexpected(parsed.error());
  archive_ = std::make_shared<const detail::ArchiveTables>(std::move(*parsed));
  return {};
}

Status FileView::open_coded(const DecodeLimits& limits) {
  // Sizes below are size_t.
  std::uint64_t budget =
      std::min<std::uint64_t>(limits.decoded_bytes(bytes_.size()), std::numeric_limits<std::size_t>::max() / 2);
  std::vector<FrameTable> tables(sections_.size());
  for (std::size_t i = 0; i < sections_.size(); ++i) {
    const SectionEntry& s = sections_[i];
    const auto type = static_cast<SectionType>(s.type);
    if (!coded_type(type) || s.codec == static_cast<std::uint32_t>(Codec::none)) continue;
    const bool of_gaussians = type != SectionType::sh_steps && type != SectionType::chunks;
    auto table = parse_frame_table(stored(s), s, s.decoded_bytes / row_bytes(type, header_.sh_degree),
                                   of_gaussians ? header_.chunk_size : 1);
    if (!table) return tl::unexpected(table.error());
    tables[i] = std::move(*table);
    frames_.resize(sections_.size());
    if (s.decoded_bytes > budget) {
      return make_error(Errc::limit_exceeded, detail::section_entry_offset(i) + 32,
                        "coded sections decode to more than the caller allows for a file of this size (max_expansion)",
                        budget, s.decoded_bytes);
    }
    budget -= s.decoded_bytes;
  }
  if (frames_.empty()) return {};
  frames_ = std::move(tables);
  if (Status s = open_archive(stored(SectionType::archive)); !s) return s;
  auto decoded_tables = std::make_shared<Tables>();
  for (const auto& [type, place] :
       {std::pair(SectionType::chunks, &Tables::chunks), std::pair(SectionType::sh_steps, &Tables::scales)}) {
    if (frames(type).rows == 0) continue;
    auto bytes = decode_table(*this, type);
    if (!bytes) return tl::unexpected(bytes.error());
    (*decoded_tables).*place = std::move(*bytes);
  }
  tables_ = std::move(decoded_tables);
  return {};
}

}  // namespace rgs
