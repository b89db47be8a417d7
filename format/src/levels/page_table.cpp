// page_table.cpp - section LODS. Checks in the order of docs/format/FORMAT.md "Reading levels safely".
// SPDX-License-Identifier: Apache-2.0
#include "levels/page_table.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "file/byte_reader.hpp"
#include "file/byte_writer.hpp"
#include "file/chunk_summary.hpp"
#include "file/layout_io.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/quantize.hpp"

namespace rgs::detail {
namespace {

// Offsets of fields in a record.
constexpr std::uint64_t kOffsetField = 0, kStoredField = 16, kCountField = 20, kParentField = 24, kChildrenField = 28,
                        kLevelField = 32, kExponentField = 34, kErrorField = 36, kBoundsField = 40, kCornerField = 64,
                        kStepSetsField = 76, kCoreField = 80, kOriginsField = 104, kReservedField = 106;

std::uint64_t field_of(lod::PageField field) {
  switch (field) {
    case lod::PageField::count: return kCountField;
    case lod::PageField::level: return kLevelField;
    case lod::PageField::parent: return kParentField;
    case lod::PageField::children: return kChildrenField;
    case lod::PageField::bounds: return kBoundsField;
    case lod::PageField::core: return kCoreField;
    case lod::PageField::error: break;
  }
  return kErrorField;
}

constexpr std::uint64_t record_at(std::uint64_t section, std::uint64_t page) {
  return section + kLevelsHeadBytes + page * kPageRecordBytes;
}

// Parses a record and checks all but its offset and its relations to other pages.
Status parse_record(ByteReader& in, const PageContext& context, std::uint32_t page_chunks, lod::Page& page,
                    StoredPage& stored) {
  const std::uint64_t at = in.offset();
  const auto bad = [at](std::uint64_t field, const char* what, std::uint64_t found) {
    return make_error(Errc::bad_value, at + field, what, Error::kNone, found);
  };
  const bool archive = is_archive(static_cast<Codec>(context.pages.codec));
  stored.offset = in.u64();
  stored.xxh3 = in.u64();
  stored.stored_bytes = in.u32();
  page.count = in.u32();
  page.parent = in.u32();
  page.first_child = in.u32();
  page.level = in.u8();
  page.n_children = in.u8();
  stored.scale_exponent = in.i16();
  page.error = in.f32();
  for (float& value : page.bounds.min) value = in.f32();
  for (float& value : page.bounds.max) value = in.f32();
  for (std::uint32_t& value : stored.corner) value = in.u32();
  stored.n_step_sets = in.u32();
  for (float& value : page.core.min) value = in.f32();
  for (float& value : page.core.max) value = in.f32();
  stored.n_origins = in.u16();
  if (!in.zeros(kPageRecordBytes - kReservedField)) {
    return make_error(Errc::reserved_bits, at + kReservedField, "reserved bytes of a page's record are not zero");
  }
  const std::uint64_t most_origins = context.header.version_minor < 5 || archive ? 0 : page.count;
  if (stored.n_origins > most_origins) {
    return make_error(Errc::bad_value, at + kOriginsField,
                      "a page has more origins than Gaussians, or its codec or version has none", most_origins,
                      stored.n_origins);
  }
  const bool shaped = context.pages.codec == static_cast<std::uint32_t>(Codec::archive);
  const std::uint64_t most = std::min<std::uint64_t>(std::uint64_t{page_chunks} * context.header.chunk_size,
                                                     shaped ? kMaxArchiveRows : lod::kMaxPageRows);
  if (page.count > most) {
    return make_error(Errc::bad_value, at + kCountField, "a page has more Gaussians than LODS or its codec allows",
                      most, page.count);
  }
  const std::uint64_t n_chunks = chunks_of(page.count, context.header.chunk_size);
  const bool own_sets = stored.n_step_sets == n_chunks || (stored.n_step_sets == 1 && !archive);
  if (!own_sets) {
    return bad(kStepSetsField, "a page has neither one set of SH steps nor one a chunk", stored.n_step_sets);
  }
  const int exponent = stored.scale_exponent;
  const bool leaf_exponent = page.level != 0 || exponent == context.header.scale_exponent;
  if (exponent < -kMaxScaleExponent || exponent > kMaxScaleExponent || !leaf_exponent) {
    return make_error(Errc::bad_value, at + kExponentField,
                      "a page's scale exponent is not between -110 and 110, or a leaf's is not the header's");
  }
  for (std::size_t k = 0; k < 3; ++k) {
    if (stored.corner[k] >= (archive ? 1u << 28 : 1u)) {
      return bad(kCornerField + 4 * k, "a page's corner is beyond any grid, or its codec has none", stored.corner[k]);
    }
  }
  return {};
}

void put_head(const PageTable& table, std::uint32_t n_levels, ByteWriter& out) {
  out.u32(static_cast<std::uint32_t>(table.pages.size()));
  out.u32(n_levels);
  out.u32(table.page_chunks);
  out.u32(0);
  out.u64(table.n_stored);
  out.f32(table.quality_db);
  out.pad_to(kLevelsHeadBytes);
}

void put_record(const lod::Page& page, const StoredPage& stored, ByteWriter& out) {
  out.u64(stored.offset);
  out.u64(stored.xxh3);
  out.u32(stored.stored_bytes);
  out.u32(page.count);
  out.u32(page.parent);
  out.u32(page.first_child);
  out.u8(static_cast<std::uint8_t>(page.level));
  out.u8(static_cast<std::uint8_t>(page.n_children));
  out.i16(stored.scale_exponent);
  out.f32(page.error);
  for (const float value : page.bounds.min) out.f32(value);
  for (const float value : page.bounds.max) out.f32(value);
  for (const std::uint32_t value : stored.corner) out.u32(value);
  out.u32(stored.n_step_sets);
  for (const float value : page.core.min) out.f32(value);
  for (const float value : page.core.max) out.f32(value);
  out.u16(stored.n_origins);
  out.zeros(kPageRecordBytes - kReservedField);
}

// XXH3 of the section that a whole table was parsed from: parsing loses nothing.
std::uint64_t hash_of(const PageTable& table) {
  ByteWriter head;
  put_head(table, table.n_levels, head);
  Hasher hash;
  hash.update(head.bytes());
  for (std::size_t i = 0; i < table.pages.size(); ++i) {
    ByteWriter record;
    put_record(table.pages[i], table.stored[i], record);
    hash.update(record.bytes());
  }
  return hash.digest();
}

// Checks that pages from .. end - 1 follow known ones before them, and end their section if all are known.
Status check_places(const PageContext& context, const PageTable& table, std::size_t from, std::size_t end) {
  const bool direct = context.pages.codec == static_cast<std::uint32_t>(Codec::none);
  const std::uint64_t section_end = context.pages.offset + context.pages.stored_bytes;
  const auto end_before = [&](std::size_t i) {
    if (i == 0) return context.pages.offset;
    const StoredPage& before = table.stored[i - 1];
    return table.is_known(i - 1) ? before.offset + before.stored_bytes
                                 : std::max(table.stored[i].offset, context.pages.offset);
  };
  for (std::size_t i = from; i < end; ++i) {
    const StoredPage& page = table.stored[i];
    const std::uint64_t at = record_at(context.levels.offset, i);
    const std::uint64_t start = direct ? align_up(end_before(i), kPageAlignment) : end_before(i);
    if (page.offset < start) {
      return make_error(Errc::section_overlap, at + kOffsetField, "a page overlaps the bytes before it", start,
                        page.offset);
    }
    if (page.offset > start) {
      return make_error(Errc::section_gap, at + kOffsetField, "bytes before a page belong to no page", start,
                        page.offset);
    }
    if (direct) {
      const std::uint64_t bytes =
          page_layout(table.pages[i].count, context.header.chunk_size, page.n_step_sets, context.header.sh_degree)
              .bytes +
          page.n_origins * kPageOriginBytes;
      if (page.stored_bytes != bytes) {
        return make_error(Errc::size_mismatch, at + kStoredField, "a page's size contradicts its counts", bytes,
                          page.stored_bytes);
      }
    }
    if (page.offset > section_end || page.stored_bytes > section_end - page.offset) {
      return make_error(Errc::size_mismatch, at + kStoredField, "a page reaches beyond its section", section_end,
                        page.stored_bytes);
    }
  }
  const StoredPage& last = table.stored[end - 1];
  if (end == table.n_pages && last.offset + last.stored_bytes != section_end) {
    return make_error(Errc::size_mismatch, last.offset + last.stored_bytes, "bytes after the last page", section_end,
                      last.offset + last.stored_bytes);
  }
  return {};
}

// The same for the tree. Sets Page::first, to the right number once all pages are known.
Status check_tree(const PageContext& context, PageTable& table, std::size_t from, std::size_t end) {
  std::uint64_t first = from == 0 ? 0 : table.pages[from - 1].first + table.pages[from - 1].count;
  for (std::size_t i = from; i < end; ++i) {
    lod::Page& page = table.pages[i];
    const lod::PageFault fault = lod::check_page(table.pages, i, context.header.chunk_size, table.n_pages);
    if (fault.what != nullptr) {
      return make_error(Errc::bad_value, record_at(context.levels.offset, i) + field_of(fault.field), fault.what);
    }
    page.first = first;
    first += page.count;
  }
  if (from == 0 && end == table.n_pages && first != table.n_stored) {
    return make_error(Errc::bad_value, context.levels.offset + 16,
                      "the pages' Gaussians do not add up to those of LODS", table.n_stored, first);
  }
  return {};
}

Status check_range(const PageContext& context, PageTable& table, std::size_t from, std::size_t end) {
  if (Status s = check_places(context, table, from, end); !s) return s;
  return check_tree(context, table, from, end);
}

Status check_whole(const PageContext& context, const PageTable& table) {
  const Header& h = context.header;
  std::uint64_t leaves = 0, decoded = 0;  // at most 2^32 pages of at most 2^24 bytes
  for (std::size_t i = 0; i < table.pages.size(); ++i) {
    const lod::Page& page = table.pages[i];
    if (page.level == 0) leaves += page.count;
    decoded += page_layout(page.count, h.chunk_size, table.stored[i].n_step_sets, h.sh_degree).bytes;
  }
  if (leaves != h.n_gaussians) {
    return make_error(Errc::bad_value, context.levels.offset + 16,
                      "the number of Gaussians in leaves differs from the header's", h.n_gaussians, leaves);
  }
  if (table.pages.front().level + 1 != table.n_levels) {
    return make_error(Errc::bad_value, context.levels.offset + 4, "the number of levels differs from the pages'",
                      table.pages.front().level + 1, table.n_levels);
  }
  if (context.pages.codec != static_cast<std::uint32_t>(Codec::none) && context.pages.decoded_bytes != decoded) {
    return make_error(Errc::size_mismatch, context.pages_entry + 32, "a section's size contradicts its pages' counts",
                      decoded, context.pages.decoded_bytes);
  }
  return {};
}

// Pages from .. end - 1 are new; `end` grows from `from` on.
Status extend(std::span<const std::byte> records, const PageContext& context, PageTable& table, std::size_t from,
              std::size_t& end) {
  ByteReader in(records, record_at(context.levels.offset, from));
  for (const std::size_t n = from + records.size() / kPageRecordBytes; end < n && !table.is_known(end); ++end) {
    lod::Page page;
    StoredPage stored;
    if (Status s = parse_record(in, context, table.page_chunks, page, stored); !s) return s;
    if (end > from && page.parent < end && !table.is_known(page.parent)) break;
    table.pages[end] = page, table.stored[end] = stored;
  }
  // A known page behind them now has others before it.
  const bool joins = table.is_known(end);
  if (Status s = check_range(context, table, from, joins ? end + 1 : end); !s) return s;
  if (joins && table.pages[end].n_children > 0 &&
      table.pages[end].first_child != table.pages[end - 1].first_child + table.pages[end - 1].n_children) {
    return make_error(Errc::bad_value, record_at(context.levels.offset, end) + kChildrenField,
                      "the children of pages do not follow each other");
  }
  while (table.is_known(table.n_ordered)) ++table.n_ordered;
  if (table.n_ordered < table.n_pages) return {};
  if (from > 0) {
    if (Status s = check_hash(context.levels, hash_of(table)); !s) return s;
    if (Status s = check_range(context, table, 0, table.n_pages); !s) return s;
  }
  return check_whole(context, table);
}

}  // namespace

std::vector<std::byte> write_page_table(const PageTable& table) {
  ByteWriter out;
  put_head(table, table.pages.front().level + 1, out);
  for (std::size_t i = 0; i < table.pages.size(); ++i) {
    lod::Page page = table.pages[i];
    for (float& value : page.core.min) value += 0.f;  // no -0
    for (float& value : page.core.max) value += 0.f;
    put_record(page, table.stored[i], out);
  }
  return out.take();
}

Status check_hash(const SectionEntry& entry, std::uint64_t hash) {
  if (hash == entry.xxh3) return {};
  return make_error(Errc::checksum_mismatch, entry.offset, "a section's checksum does not match", entry.xxh3, hash);
}

Result<PageTable> parse_levels_head(std::span<const std::byte> bytes, const PageContext& context,
                                    const DecodeLimits& limits) {
  const std::uint64_t at = context.levels.offset;
  const Header& h = context.header;
  ByteReader in(bytes, at);
  PageTable table;
  const std::uint32_t n_pages = in.u32(), n_levels = in.u32();
  table.page_chunks = in.u32();
  const std::uint32_t reserved = in.u32();
  table.n_stored = in.u64();
  table.quality_db = in.f32();
  const bool zeros = in.zeros(kLevelsHeadBytes - 28);
  if (!in.ok() || context.levels.stored_bytes != kLevelsHeadBytes + n_pages * kPageRecordBytes) {
    return make_error(Errc::size_mismatch, context.levels_entry + 32,
                      "the size of LODS contradicts its number of pages", kLevelsHeadBytes + n_pages * kPageRecordBytes,
                      context.levels.stored_bytes);
  }
  if (reserved != 0) return make_error(Errc::reserved_bits, at + 12, "a reserved field of LODS is set");
  if (!zeros) return make_error(Errc::reserved_bits, at + 28, "reserved bytes of LODS are not zero");
  if (n_pages == 0 || n_pages == lod::kNoPage) {
    return make_error(Errc::bad_value, at, "the number of pages is not between 1 and 2^32 - 2", Error::kNone, n_pages);
  }
  if (n_levels == 0 || n_levels > lod::kMaxLevels) {
    return make_error(Errc::bad_value, at + 4, "the number of levels is not between 1 and 64", Error::kNone, n_levels);
  }
  if (table.page_chunks == 0 || table.page_chunks > lod::kMaxPageChunks ||
      std::uint64_t{table.page_chunks} * h.chunk_size > lod::kMaxPageRows) {
    return make_error(Errc::bad_value, at + 8,
                      "the largest page has no chunks, or more than 1,024, or more than 2^16 Gaussians", Error::kNone,
                      table.page_chunks);
  }
  if (table.n_stored > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, at + 16, "more Gaussians than the caller allows", limits.max_gaussians,
                      table.n_stored);
  }
  if (!(table.quality_db >= 0 && std::isfinite(table.quality_db))) {
    return make_error(Errc::bad_value, at + 24, "the quality that pages promise is negative or not finite");
  }
  table.n_pages = n_pages;
  table.n_levels = n_levels;
  return table;
}

Status extend_page_table(std::span<const std::byte> records, const PageContext& context, PageTable& table,
                         std::size_t from) {
  const std::size_t before = table.pages.size(), n = from + records.size() / kPageRecordBytes;
  const std::uint32_t n_ordered = table.n_ordered;
  if (n > before) {
    // Not beyond twice the known pages, and never beyond the total.
    const std::size_t room = std::min<std::size_t>(std::max(n, 2 * before), table.n_pages);
    if (n > table.pages.capacity()) table.pages.reserve(room);
    if (n > table.stored.capacity()) table.stored.reserve(room);
    table.pages.resize(n);
    table.stored.resize(n);
  }
  std::size_t end = from;
  Status extended = guard_memory([&] { return extend(records, context, table, from, end); });
  if (!extended) {
    std::fill(table.pages.begin() + static_cast<std::ptrdiff_t>(from),
              table.pages.begin() + static_cast<std::ptrdiff_t>(end), lod::Page());
    table.pages.resize(before);
    table.stored.resize(before);
    table.n_ordered = n_ordered;
  }
  return extended;
}

Status check_decoded_bytes(const PageContext& context, const DecodeLimits& limits, std::uint64_t file_bytes) {
  if (context.pages.codec != static_cast<std::uint32_t>(Codec::none) &&
      context.pages.decoded_bytes > limits.decoded_bytes(file_bytes)) {
    return make_error(Errc::limit_exceeded, context.pages_entry + 32,
                      "pages decode to more than the caller allows for a file of this size (max_expansion)",
                      limits.decoded_bytes(file_bytes), context.pages.decoded_bytes);
  }
  return {};
}

PageRows page_rows(std::span<const std::byte> out, const PageLayout& l, std::uint32_t n, int scale_exponent,
                   int sh_degree) {
  PageRows rows;
  rows.n = n;
  rows.scale_exponent = scale_exponent;
  rows.chunks = out.subspan(l.chunks, l.steps - l.chunks);
  rows.steps = out.subspan(l.steps, l.means - l.steps);
  rows.means = out.subspan(l.means, n * kMeanBytes);
  rows.geometry = out.subspan(l.geometry, n * kGeometryBytes);
  rows.sh = out.subspan(l.sh, n * sh_bytes(sh_degree));
  return rows;
}

void derive_chunks(std::span<std::byte> decoded, const PageLayout& l, std::uint32_t n, std::uint32_t chunk_size,
                   std::uint64_t n_step_sets, int scale_exponent) {
  ByteWriter out;
  for (std::uint64_t first = 0, chunk = 0; first < n; first += chunk_size, ++chunk) {
    ChunkSummary summary;
    summary.set(decoded.data() + l.means + first * kMeanBytes, decoded.data() + l.geometry + first * kGeometryBytes,
                static_cast<std::uint32_t>(std::min<std::uint64_t>(chunk_size, n - first)));
    ChunkEntry entry = summary.entry(scale_exponent);
    entry.step_set = n_step_sets == 1 ? 0 : chunk;
    write_chunk_entry(out, entry);
  }
  std::ranges::copy(out.bytes(), decoded.begin() + static_cast<std::ptrdiff_t>(l.chunks));
}

Extent extent_of(const std::byte* mean, const std::byte* geometry, int scale_exponent) {
  float position[3];
  std::uint16_t row[8];
  std::memcpy(position, mean, sizeof position);
  std::memcpy(row, geometry, sizeof row);
  double q[4], squared = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    q[i] = static_cast<double>(float_from_half(row[i]));
    squared += q[i] * q[i];
  }
  for (double& value : q) value /= std::sqrt(squared);
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  Extent extent;
  for (std::size_t k = 0; k < 3; ++k) {
    double variance = 0;
    for (std::size_t j = 0; j < 3; ++j) {
      const double side = r[k][j] * static_cast<double>(dequantize_scale(row[4 + j], scale_exponent));
      variance += side * side;
    }
    extent.mean[k] = static_cast<double>(position[k]);
    extent.reach[k] = 3 * std::sqrt(variance);
  }
  return extent;
}

RoomInBox::RoomInBox(const Box& box, int scale_exponent)
    : box_(box),
      scale_unit_(std::ldexp(1.0, -scale_exponent)),
      in_fp32_{{box.min[0], box.min[1], box.min[2]},
               {box.max[0], box.max[1], box.max[2]},
               std::ldexp(1.F, -scale_exponent),
               std::ldexp(1.F, scale_exponent)} {}

std::uint64_t RoomInBox::undecided(const std::byte* means, const std::byte* geometry, std::size_t count) const {
  const std::uint64_t all = ~std::uint64_t{0} >> (64 - count);
  return all & ~row_kernels().in_box(in_fp32_, means, geometry, count);
}

// Bounds of rounding errors, to first order, with u = 2^-53 and s the largest scale. Errors that do not shrink with the
// reach are subtracted from the room; the rest is a few u of the reach or the room, which the gap between kShare and
// kExtentShare covers many times over.
//
//   here         as in row_kernels.cpp, where the same is done in binary32: 75 u of s
//   extent_of()  |q|^2: 3 u of it; w, x, y, z: 4 u of each; their products: 9 u; r on its diagonal: yy + zz, at most 1, is wrong by 10 u of
//                it, so twice that and u for the difference: 21 u; r elsewhere: 9 u of |xy| + |wz|, at most 1/2, and u / 2 for the sum, all
//                twice: 10 u; r s: 22 u of s; |r s|, three of them: sqrt(3) * 22 u = 39 u of s; reach: 117 u of s
//
// 192 u of s in all. No number here becomes small enough to lose bits.
bool RoomInBox::is_enough(const std::byte* mean, const std::byte* geometry) const {
  constexpr double kShare = 1 - 0x1p-11, kSquaredShare = 9 * kShare * kShare, kSlack = 192 * 0x1p-53;
  float position[3];
  std::uint16_t row[8];
  std::memcpy(position, mean, sizeof position);
  std::memcpy(row, geometry, sizeof row);
  double room[3];
  for (std::size_t k = 0; k < 3; ++k) {
    const auto x = static_cast<double>(position[k]);
    room[k] = std::min(x - static_cast<double>(box_.min[k]), static_cast<double>(box_.max[k]) - x);
  }
  const auto scale = [&](std::uint16_t code) { return static_cast<double>(float_from_half(code)) * scale_unit_; };
  // It reaches no farther in any direction. FP16 bits of non-negative numbers order as the numbers do.
  const double largest = scale(std::max({row[4], row[5], row[6]})), farthest = 3 * largest;
  if (farthest <= room[0] && farthest <= room[1] && farthest <= room[2]) return true;
  for (double& left : room) left -= kSlack * largest;
  if (!(room[0] >= 0 && room[1] >= 0 && room[2] >= 0)) return false;
  double q[4], squared = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    q[i] = static_cast<double>(float_from_half(row[i]));
    squared += q[i] * q[i];
  }
  const double f = 2 / squared, w = q[0], x = q[1], y = q[2], z = q[3];
  const double r[3][3] = {{1 - f * (y * y + z * z), f * (x * y - w * z), f * (x * z + w * y)},
                          {f * (x * y + w * z), 1 - f * (x * x + z * z), f * (y * z - w * x)},
                          {f * (x * z - w * y), f * (y * z + w * x), 1 - f * (x * x + y * y)}};
  const double scales[3] = {scale(row[4]), scale(row[5]), scale(row[6])};
  for (std::size_t k = 0; k < 3; ++k) {
    double variance = 0;
    for (std::size_t j = 0; j < 3; ++j) {
      const double side = r[k][j] * scales[j];
      variance += side * side;
    }
    if (!(kSquaredShare * variance <= room[k] * room[k])) return false;
  }
  return true;
}

}  // namespace rgs::detail
