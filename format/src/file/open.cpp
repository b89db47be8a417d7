// open.cpp - parses the head of an .rgs file and checks it before use.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <bit>

#include "file/checked.hpp"
#include "file/file_parts.hpp"
#include "file/layout_io.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

constexpr std::array kKnown = {SectionType::declarations, SectionType::sh_steps,  SectionType::chunks,
                               SectionType::means,        SectionType::geometry,  SectionType::sh,
                               SectionType::permutation,  SectionType::provenance};
constexpr std::size_t kRequired = 6;  // the first six of kKnown
// More than any legal section, so that a reader does not fetch what it will reject.
constexpr std::uint64_t kMostProvenanceBytes = std::uint64_t{1} << 16;
// Sections that a file with levels of detail must have, and must not have.
constexpr std::array kRequiredWithLevels = {SectionType::declarations, SectionType::levels, SectionType::pages};
constexpr std::array kInPages = {SectionType::sh_steps, SectionType::chunks, SectionType::means, SectionType::geometry,
                                 SectionType::sh};

bool of_levels(SectionType type) {
  return type == SectionType::levels || type == SectionType::pages;
}

bool known(std::uint32_t type, std::uint16_t minor) {
  return std::ranges::find(kKnown, static_cast<SectionType>(type)) != kKnown.end() ||
         (minor >= 2 && type == static_cast<std::uint32_t>(SectionType::archive)) ||
         (minor >= 4 && of_levels(static_cast<SectionType>(type))) ||
         (minor >= 5 && type == static_cast<std::uint32_t>(SectionType::crs));
}

bool known_codec(const SectionEntry& s, std::uint16_t minor) {
  const auto type = static_cast<SectionType>(s.type);
  switch (static_cast<Codec>(s.codec)) {
    case Codec::none: return true;
    case Codec::planes: return minor >= 1 && (coded_type(type) || type == SectionType::pages);
    case Codec::archive_draco: return minor >= 2 && (archive_type(type) || type == SectionType::pages);
    case Codec::archive: return minor >= 5 && (archive_type(type) || type == SectionType::pages);
  }
  return false;
}

// Sections lie in table order, each at the next multiple of 256, with zeros between, up to the end of the file. `bytes`
// may be a prefix of it.
Status check_placement(std::span<const std::byte> bytes, std::uint64_t file_bytes,
                       std::span<const SectionEntry> sections, std::uint64_t head_bytes) {
  std::uint64_t end = head_bytes;
  for (std::size_t i = 0; i < sections.size(); ++i) {
    const SectionEntry& s = sections[i];
    const std::uint64_t at = detail::section_entry_offset(i);
    const std::uint64_t start = detail::align_up(end, kSectionAlignment);
    if (s.offset % kSectionAlignment != 0) {
      return make_error(Errc::bad_section, at + 16, "a section does not start at a multiple of 256", start, s.offset);
    }
    if (s.offset < end) {
      return make_error(Errc::section_overlap, at + 16, "a section overlaps the bytes before it", start, s.offset);
    }
    if (s.offset > start) {
      return make_error(Errc::section_gap, at + 16, "bytes before a section belong to no section", start, s.offset);
    }
    if (s.offset > file_bytes || s.stored_bytes > file_bytes - s.offset) {
      return make_error(Errc::bad_section, at + 24, "a section reaches beyond the end of the file", file_bytes,
                        s.stored_bytes);
    }
    for (std::uint64_t p = end; p < std::min<std::uint64_t>(s.offset, bytes.size()); ++p) {
      if (bytes[p] != std::byte{0}) return make_error(Errc::section_gap, p, "padding before a section is not zero");
    }
    end = s.offset + s.stored_bytes;
  }
  if (end != file_bytes) {
    return make_error(Errc::section_gap, end, "bytes after the last section belong to no section", file_bytes, end);
  }
  return {};
}

Status missing(SectionType type) {
  return make_error(Errc::missing_section, kHeaderBytes, "a required section is missing",
                    static_cast<std::uint64_t>(type));
}

// Checks that all required sections are there, with or without levels of detail, and that sections that a reader needs
// before the first page precede the pages, so that a prefix of the file is usable.
Status check_required(std::span<const SectionEntry> sections, std::uint16_t minor, bool levels) {
  const auto count = [&](SectionType type) {
    return std::ranges::count(sections, static_cast<std::uint32_t>(type), &SectionEntry::type);
  };
  if (!levels) {
    for (const SectionType type : std::span(kKnown).first(kRequired)) {
      if (count(type) == 0) return missing(type);
    }
    return {};
  }
  for (const SectionType type : kRequiredWithLevels) {
    if (count(type) == 0) return missing(type);
  }
  bool after_pages = false;
  for (std::size_t i = 0; i < sections.size(); ++i) {
    const auto type = static_cast<SectionType>(sections[i].type);
    const std::uint64_t at = detail::section_entry_offset(i);
    if (std::ranges::find(kInPages, type) != kInPages.end()) {
      return make_error(Errc::bad_section, at, "a file with levels of detail has its Gaussians in pages, not sections",
                        Error::kNone, sections[i].type);
    }
    const bool needed = type == SectionType::declarations || type == SectionType::levels ||
                        type == SectionType::archive || (type == SectionType::crs && minor >= 5);
    if (after_pages && needed) {
      return make_error(Errc::bad_section, at, "DECL, LODS, ARCH and CREF come before PAGE", Error::kNone,
                        sections[i].type);
    }
    after_pages = after_pages || type == SectionType::pages;
  }
  return {};
}

// Whether the table is that of a file with levels.
bool names_levels(std::span<const SectionEntry> sections, std::uint16_t minor) {
  return minor >= 4 && std::ranges::any_of(
                           sections, [](const SectionEntry& s) { return of_levels(static_cast<SectionType>(s.type)); });
}

Status check_types(std::span<const SectionEntry> sections, std::uint16_t minor) {
  for (std::size_t i = 0; i < sections.size(); ++i) {
    const SectionEntry& s = sections[i];
    const std::uint64_t at = detail::section_entry_offset(i);
    if (!known(s.type, minor)) {
      if ((s.flags & kSectionMustUnderstand) != 0) {
        return make_error(Errc::unknown_required, at,
                          "this program does not know a section that readers must understand", Error::kNone, s.type);
      }
      continue;
    }
    if (std::ranges::count(sections.first(i), s.type, &SectionEntry::type) != 0) {
      return make_error(Errc::duplicate_section, at, "a section occurs twice", Error::kNone, s.type);
    }
    if (!known_codec(s, minor)) {
      return make_error(Errc::unsupported_codec, at + 8, "this program does not know a section's codec", Error::kNone,
                        s.codec);
    }
    if (s.codec == static_cast<std::uint32_t>(Codec::none) && s.stored_bytes != s.decoded_bytes) {
      return make_error(Errc::size_mismatch, at + 32, "stored and decoded size of an uncoded section differ",
                        s.stored_bytes, s.decoded_bytes);
    }
  }
  return check_required(sections, minor, names_levels(sections, minor));
}

std::uint64_t levels_entry(std::span<const SectionEntry> sections) {
  const auto entry = std::ranges::find(sections, static_cast<std::uint32_t>(SectionType::levels), &SectionEntry::type);
  return detail::section_entry_offset(static_cast<std::size_t>(entry - sections.begin()));
}

// The archive codec of a file's sections; none if there is none. Ignores the codec of unknown types.
Codec archive_codec(std::span<const SectionEntry> sections, std::uint16_t minor) {
  for (const SectionEntry& s : sections) {
    const auto type = static_cast<SectionType>(s.type);
    const bool may = archive_type(type) || (type == SectionType::pages && minor >= 4);
    if (may && is_archive(static_cast<Codec>(s.codec))) return static_cast<Codec>(s.codec);
  }
  return Codec::none;
}

// Archive codecs are on MEAN, GEOM and SHI8 together or on PAGE, with ARCH; or on none.
Status check_archive(std::span<const SectionEntry> sections, std::uint16_t minor) {
  const auto codec = static_cast<std::uint32_t>(archive_codec(sections, minor));
  bool tables = false;
  for (std::size_t i = 0; i < sections.size(); ++i) {
    const std::uint64_t at = detail::section_entry_offset(i);
    const auto type = static_cast<SectionType>(sections[i].type);
    if (codec != 0 && archive_type(type) && sections[i].codec != codec) {
      return make_error(Errc::unsupported_codec, at + 8, "MEAN, GEOM and SHI8 do not have the same codec", codec,
                        sections[i].codec);
    }
    if (type != SectionType::archive || minor < 2) continue;
    tables = true;
    if (codec == 0) return make_error(Errc::bad_section, at, "section ARCH belongs to no section of its codec");
  }
  if (codec != 0 && !tables) return missing(SectionType::archive);
  return {};
}

// Checks the size of table entry `index` against `count` records of `bytes` bytes.
Status check_size(const FileView& view, std::size_t index, std::uint64_t count, std::uint64_t bytes) {
  std::uint64_t size = 0;
  if (!detail::multiply(count, bytes, size)) {
    return make_error(Errc::size_mismatch, detail::section_entry_offset(index) + 32,
                      "the header's counts imply a section larger than 2^64 bytes", Error::kNone, count);
  }
  const std::uint64_t found = view.sections()[index].decoded_bytes;
  if (size != found) {
    return make_error(Errc::size_mismatch, detail::section_entry_offset(index) + 32,
                      "a section's size contradicts the header's counts", size, found);
  }
  return {};
}

// Checks sizes that follow from the header alone, and the one that is limited.
Status check_sizes(const FileView& view) {
  const Header& h = view.header();
  for (std::size_t i = 0; i < view.sections().size(); ++i) {
    std::uint64_t count = h.n_gaussians, bytes = 0;
    switch (static_cast<SectionType>(view.sections()[i].type)) {
      case SectionType::declarations: count = 1, bytes = kDeclarationBytes; break;
      case SectionType::sh_steps: count = h.n_step_sets, bytes = kStepSetBytes; break;
      case SectionType::chunks: count = h.n_chunks, bytes = kChunkEntryBytes; break;
      case SectionType::means: bytes = kMeanBytes; break;
      case SectionType::geometry: bytes = kGeometryBytes; break;
      case SectionType::sh: bytes = sh_bytes(h.sh_degree); break;
      case SectionType::crs:
        if (const std::uint64_t size = view.sections()[i].decoded_bytes;
            view.header().version_minor >= 5 && (size <= kCrsHeadBytes || size > kCrsHeadBytes + kMaxCrsText))
          return make_error(Errc::size_mismatch, detail::section_entry_offset(i) + 32,
                            "the coordinate reference system's text is empty or longer than 16,384 bytes",
                            kCrsHeadBytes + kMaxCrsText, size);
        continue;
      default: continue;
    }
    if (const Status s = check_size(view, i, count, bytes); !s) return s;
  }
  return {};
}

Status check_hash(std::span<const std::byte> bytes, const SectionEntry& s) {
  const std::uint64_t hash = xxh3(bytes);
  if (hash != s.xxh3)
    return make_error(Errc::checksum_mismatch, s.offset, "a section's checksum does not match", s.xxh3, hash);
  return {};
}

Status too_short(const FileView& view) {
  return make_error(Errc::truncated, view.bytes().size(), "the file ends before its first page",
                    view.header().file_bytes, view.bytes().size());
}

}  // namespace

const SectionEntry* FileView::find(SectionType type) const {
  for (const SectionEntry& entry : sections_) {
    if (entry.type == static_cast<std::uint32_t>(type)) return &entry;
  }
  return nullptr;
}

std::span<const std::byte> FileView::stored(SectionType type) const {
  const SectionEntry* entry = find(type);
  return entry == nullptr ? std::span<const std::byte>() : stored(*entry);
}

Result<FileView> FileView::open(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return detail::guard_memory([&] {
    const FilePart whole{0, bytes};
    return parse({&whole, 1}, bytes.size(), limits, false);
  });
}

// Stored bytes of a section that lies entirely in one part.
std::optional<std::span<const std::byte>> FileView::bytes_of(const SectionEntry& entry,
                                                             std::span<const FilePart> parts) {
  for (const FilePart& part : parts) {
    const std::uint64_t size = part.bytes.size(), skipped = entry.offset - part.offset;
    if (part.offset <= entry.offset && skipped <= size && entry.stored_bytes <= size - skipped) {
      return part.bytes.subspan(skipped, entry.stored_bytes);
    }
  }
  return {};
}

Status FileView::parse_declarations(std::span<const FilePart> parts) {
  const SectionEntry& entry = *find(SectionType::declarations);
  const auto bytes = bytes_of(entry, parts);
  if (!bytes) return too_short(*this);
  if (const Status s = check_hash(*bytes, entry); !s) return s;
  const auto declarations = detail::parse_declarations(*bytes, entry.offset, header_.version_minor);
  if (!declarations) return tl::unexpected(declarations.error());
  declarations_ = *declarations;
  if (declarations_.n_dropped > declarations_.n_source ||
      declarations_.n_source - declarations_.n_dropped != header_.n_gaussians) {
    return make_error(Errc::bad_value, entry.offset + 96,
                      "source count less dropped count is not the number of Gaussians", header_.n_gaussians,
                      declarations_.n_source);
  }
  return {};
}

// Parses header and section table. `levels`: the file must have levels of detail. The file has `size` bytes; `bytes`
// may be a prefix.
Result<FileView> FileView::parse_head(std::span<const std::byte> bytes, std::uint64_t size, const DecodeLimits& limits,
                                      bool levels) {
  const auto header = detail::parse_header(bytes);
  if (!header) return tl::unexpected(header.error());
  if (header->file_bytes > limits.max_file_bytes) {
    return make_error(Errc::limit_exceeded, 16, "the file is larger than the caller allows", limits.max_file_bytes,
                      header->file_bytes);
  }
  if (header->n_gaussians > limits.max_gaussians) {
    return make_error(Errc::limit_exceeded, 24, "more Gaussians than the caller allows", limits.max_gaussians,
                      header->n_gaussians);
  }
  const std::uint64_t table_end = detail::section_entry_offset(header->n_sections);
  const std::uint64_t head_bytes = table_end + kHeadChecksumBytes;
  if (size < (levels ? head_bytes : header->file_bytes)) {
    return make_error(Errc::truncated, size, "the file is shorter than its header says", header->file_bytes, size);
  }
  if (size > header->file_bytes) {
    return make_error(Errc::trailing_bytes, header->file_bytes, "the file is longer than its header says",
                      header->file_bytes, size);
  }
  if (bytes.size() < head_bytes) {
    return make_error(Errc::truncated, bytes.size(), "the head is incomplete", head_bytes, bytes.size());
  }
  const std::uint64_t stored_hash = detail::ByteReader(bytes.subspan(table_end)).u64();
  const std::uint64_t hash = xxh3(bytes.first(table_end));
  if (stored_hash != hash) {
    return make_error(Errc::checksum_mismatch, table_end, "the checksum of header and section table does not match",
                      stored_hash, hash);
  }

  FileView view;
  view.bytes_ = bytes;
  view.header_ = *header;
  view.sections_.reserve(header->n_sections);
  for (std::size_t i = 0; i < header->n_sections; ++i) {
    const std::uint64_t at = detail::section_entry_offset(i);
    const auto entry = detail::parse_section_entry(bytes.subspan(at, kSectionEntryBytes), at);
    if (!entry) return tl::unexpected(entry.error());
    view.sections_.push_back(*entry);
  }
  if (const Status s = check_types(view.sections_, header->version_minor); !s) return tl::unexpected(s.error());
  if (const Status s = check_archive(view.sections_, header->version_minor); !s) return tl::unexpected(s.error());
  const bool named = names_levels(view.sections_, header->version_minor);
  if (named && !levels) {
    return make_error(
        Errc::unsupported_feature, levels_entry(view.sections_),
        "the file has levels of detail, which this program does not read: rgs-convert can write its finest "
        "level, or another one, as a file without levels");
  }
  if (!named && levels) {
    return make_error(Errc::missing_section, kHeaderBytes, "the file has no levels of detail",
                      static_cast<std::uint64_t>(SectionType::levels));
  }
  if (const Status s = check_placement(bytes, header->file_bytes, view.sections_, head_bytes); !s)
    return tl::unexpected(s.error());
  if (const Status s = check_sizes(view); !s) return tl::unexpected(s.error());
  return view;
}

// Parses what precedes the Gaussians in all files: head, declarations, provenance and CRS if there are any. The first
// part has the file's first bytes.
Result<FileView> FileView::parse_front(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits,
                                       bool levels) {
  auto parsed = parse_head(parts.front().bytes, size, limits, levels);
  if (!parsed) return parsed;
  FileView view = *std::move(parsed);
  if (const Status s = view.parse_declarations(parts); !s) return tl::unexpected(s.error());
  if (const SectionEntry* entry = view.find(SectionType::permutation)) {
    const auto index = static_cast<std::size_t>(entry - view.sections_.data());
    const std::uint64_t index_bytes = (view.declarations_.n_source >> 32) != 0 ? 8 : 4;
    if (const Status s = check_size(view, index, view.header_.n_gaussians, index_bytes); !s)
      return tl::unexpected(s.error());
  }
  if (const SectionEntry* entry = view.find(SectionType::provenance)) {
    if (const auto stored = bytes_of(*entry, parts)) {
      if (const Status s = check_hash(*stored, *entry); !s) return tl::unexpected(s.error());
      auto provenance = detail::parse_provenance(*stored, entry->offset);
      if (!provenance) return tl::unexpected(provenance.error());
      view.provenance_ = std::move(*provenance);
    }
  }
  if (const SectionEntry* entry = view.find(SectionType::crs); entry != nullptr && view.header_.version_minor >= 5) {
    if (const auto stored = bytes_of(*entry, parts)) {
      if (const Status s = check_hash(*stored, *entry); !s) return tl::unexpected(s.error());
      auto crs = detail::parse_crs(*stored, entry->offset, view.declarations_.axes);
      if (!crs) return tl::unexpected(crs.error());
      view.declarations_.crs = std::move(*crs);
    } else if (levels) {
      return tl::unexpected(too_short(view).error());
    }
  }
  return view;
}

// Without levels the whole file is the only part; with `levels` the first part has its first bytes.
Result<FileView> FileView::parse(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits,
                                 bool levels) {
  auto parsed = parse_front(parts, size, limits, levels);
  if (!parsed) return parsed;
  FileView view = *std::move(parsed);
  if (levels) {
    const SectionEntry* tables = view.find(SectionType::archive);
    if (tables == nullptr) return view;
    const auto stored = bytes_of(*tables, parts);
    if (!stored) return tl::unexpected(too_short(view).error());
    if (const Status s = view.open_archive(*stored); !s) return tl::unexpected(s.error());
    return view;
  }
  if (const Status s = view.open_coded(limits); !s) return tl::unexpected(s.error());
  return view;
}

// The longest prefix of the file that is a single part.
std::span<const std::byte> detail::beginning_of(std::span<const FilePart> parts) {
  std::span<const std::byte> most;
  for (const FilePart& part : parts) {
    if (part.offset == 0 && part.bytes.size() > most.size()) most = part.bytes;
  }
  return most;
}

Result<std::optional<FileRange>> detail::missing_head(std::span<const std::byte> beginning) {
  const auto header = parse_header(beginning);
  if (beginning.size() < kHeaderBytes) {
    // Rejects other formats as early as possible.
    if (!header && header.error().code != Errc::truncated) return tl::unexpected(header.error());
    return FileRange{0, kHeaderBytes};
  }
  if (!header) return tl::unexpected(header.error());
  const std::uint64_t head_bytes = section_entry_offset(header->n_sections) + kHeadChecksumBytes;
  if (beginning.size() < head_bytes) return FileRange{0, head_bytes};
  return std::nullopt;
}

Result<std::vector<FileRange>> FileView::head_needs(std::span<const FilePart> parts, std::uint64_t size,
                                                    const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<std::vector<FileRange>> {
    const auto beginning = detail::beginning_of(parts);
    const auto head = detail::missing_head(beginning);
    if (!head) return tl::unexpected(head.error());
    if (*head) {
      const FileRange range{0, std::min((**head).bytes, size)};
      if (beginning.size() < range.bytes) return std::vector{range};
    }
    const auto view = parse_head(beginning, size, limits, false);
    if (!view) return tl::unexpected(view.error());
    std::vector<FileRange> missing;
    for (const SectionEntry& entry : view->sections()) {
      const auto type = static_cast<SectionType>(entry.type);
      const bool wanted = type == SectionType::declarations ||
                          (type == SectionType::crs && entry.stored_bytes <= kCrsHeadBytes + kMaxCrsText) ||
                          (type == SectionType::provenance && entry.stored_bytes <= kMostProvenanceBytes);
      if (wanted && !bytes_of(entry, parts)) missing.push_back({entry.offset, entry.stored_bytes});
    }
    return missing;
  });
}

Result<FileView> FileView::open_head(std::span<const FilePart> parts, std::uint64_t size, const DecodeLimits& limits) {
  return detail::guard_memory([&]() -> Result<FileView> {
    std::vector<FilePart> from_front{{0, detail::beginning_of(parts)}};
    from_front.insert(from_front.end(), parts.begin(), parts.end());
    auto view = parse_front(from_front, size, limits, false);
    if (view) view->bytes_ = {};
    return view;
  });
}

}  // namespace rgs
