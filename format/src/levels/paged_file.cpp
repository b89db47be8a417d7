// paged_file.cpp - opens files with levels of detail, and reads and checks their pages.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/paged_file.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include "archive/archive_tables.hpp"
#include "file/file_parts.hpp"
#include "file/layout_io.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "levels/page_table.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

using namespace detail;

namespace {

// What a thread needs to decode pages.
struct PageWorker {
  PageWorker(const PagedFile& file, std::uint64_t largest) : decoder(file), memory(largest) {}
  PageDecoder decoder;
  std::vector<std::byte> memory;

  Result<PageRows> decode(const PagedFile& file, std::uint32_t page, std::vector<float>* rests = nullptr) {
    return decoder.decode(page, file.bytes(page), std::span(memory).first(file.decoded_bytes(page)), rests);
  }
};

std::vector<PageWorker> page_workers(const PagedFile& file, std::uint64_t n_pages, unsigned threads) {
  std::vector<PageWorker> workers;
  const std::uint64_t largest = file.largest_decoded_bytes();
  for (unsigned i = worker_count(n_pages, threads); i > 0; --i) workers.emplace_back(file, largest);
  return workers;
}

// Checks the bytes between pages that are stored uncoded.
Status check_padding(const PagedFile& file) {
  if (file.codec() != Codec::none) return {};
  std::uint64_t end = file.head().find(SectionType::pages)->offset;
  for (std::uint32_t i = 0; i < file.n_present(); ++i) {
    for (; end < file.stored(i).offset; ++end) {
      if (file.head().bytes()[end] != std::byte{0}) {
        return make_error(Errc::section_gap, end, "padding before a page is not zero");
      }
    }
    end += file.stored(i).stored_bytes;
  }
  return {};
}

// The context of section LODS, for a file with a sound head.
PageContext context_of(const FileView& head) {
  const auto place_of = [&](const SectionEntry* entry) {
    return section_entry_offset(static_cast<std::uint64_t>(entry - head.sections().data()));
  };
  const SectionEntry* levels = head.find(SectionType::levels);
  const SectionEntry* pages = head.find(SectionType::pages);
  return {head.header(), *levels, *pages, place_of(levels), place_of(pages)};
}

Status too_short(std::span<const std::byte> bytes, const Header& header) {
  return make_error(Errc::truncated, bytes.size(), "the file ends before its first page", header.file_bytes,
                    bytes.size());
}

// Tables have at most 73 KB before compression; a reader must not fetch more than it can use.
Status check_archive_bytes(const SectionEntry& entry) {
  constexpr std::uint64_t kMost = std::uint64_t{1} << 20;
  if (entry.stored_bytes <= kMost) return {};
  return make_error(Errc::limit_exceeded, entry.offset, "section ARCH has more than 1 MiB", kMost, entry.stored_bytes);
}

}  // namespace

bool names_section(std::span<const std::byte> bytes, SectionType wanted) {
  const auto header = parse_header(bytes);
  if (!header) return false;
  for (std::uint32_t i = 0; i < header->n_sections; ++i) {
    const std::uint64_t at = section_entry_offset(i);
    if (at > bytes.size() || bytes.size() - at < kSectionEntryBytes) return false;
    const std::uint32_t type = ByteReader(bytes.subspan(at)).u32();
    if (type == static_cast<std::uint32_t>(wanted)) return true;
  }
  return false;
}

bool has_levels(std::span<const std::byte> bytes) {
  const auto header = parse_header(bytes);
  return header && header->version_minor >= 4 && names_section(bytes, SectionType::levels);
}

Result<PagedFile> PagedFile::open(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return guard_memory([&] { return parse(bytes, limits); });
}

Result<PagedFile> PagedFile::parse(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  const FilePart whole{0, bytes};
  auto head = FileView::parse({&whole, 1}, bytes.size(), limits, true);
  if (!head) return tl::unexpected(head.error());
  PagedFile file;
  file.head_ = *std::move(head);
  const PageContext context = context_of(file.head_);
  const auto section = FileView::bytes_of(context.levels, {&whole, 1});
  if (!section) return tl::unexpected(too_short(bytes, file.head_.header()).error());
  if (Status s = file.read_table(*section, limits); !s) return tl::unexpected(s.error());
  if (Status s = check_decoded_bytes(context, limits, file.head_.header().file_bytes); !s)
    return tl::unexpected(s.error());
  if (file.codec_ != Codec::none && !file.complete()) {
    // file_bytes counts bytes that are missing, so the limit is checked again.
    std::uint64_t decoded = 0;
    const std::uint32_t n = file.n_present();
    for (std::uint32_t i = 0; i < n; ++i) decoded += file.decoded_bytes(i);
    if (decoded > limits.decoded_bytes(bytes.size())) {
      return make_error(Errc::limit_exceeded, context.pages_entry + 32,
                        "pages decode to more than the caller allows for this many bytes (max_expansion)",
                        limits.decoded_bytes(bytes.size()), decoded);
    }
  }
  return file;
}

// `section`: LODS, or at least its first record. Errors come in one order, as far as the bytes are there: a damaged file
// has one error.
Status PagedFile::read_table(std::span<const std::byte> section, const DecodeLimits& limits) {
  const PageContext context = context_of(head_);
  is_verified_ = section.size() == context.levels.stored_bytes;
  if (is_verified_) {
    if (Status s = check_hash(context.levels, xxh3(section)); !s) return s;
  }
  auto table = parse_levels_head(section, context, limits);
  if (!table) return tl::unexpected(table.error());
  table_ = *std::move(table);
  codec_ = static_cast<Codec>(context.pages.codec);
  return extend_page_table(section.subspan(kLevelsHeadBytes), context, table_, 0);
}

Result<std::vector<FileRange>> PagedFile::needs(std::span<const FilePart> parts, const DecodeLimits& limits,
                                                std::optional<std::uint64_t> size) {
  return guard_memory([&]() -> Result<std::vector<FileRange>> {
    const auto beginning = beginning_of(parts);
    const auto missing_head = detail::missing_head(beginning);
    if (!missing_head) return tl::unexpected(missing_head.error());
    if (*missing_head) return std::vector{**missing_head};
    const auto head = FileView::parse_head(beginning, size.value_or(beginning.size()), limits, true);
    if (!head) return tl::unexpected(head.error());
    std::vector<FileRange> missing;
    for (SectionEntry entry : head->sections()) {
      const auto type = static_cast<SectionType>(entry.type);
      if (type == SectionType::pages) break;
      if (type == SectionType::levels) {
        entry.stored_bytes = std::min(entry.stored_bytes, kLevelsHeadBytes + kPageRecordBytes);
      } else if (type == SectionType::archive) {
        if (Status s = check_archive_bytes(entry); !s) return tl::unexpected(s.error());
      } else if (type != SectionType::declarations &&
                 !(type == SectionType::crs && entry.stored_bytes <= kCrsHeadBytes + kMaxCrsText)) {
        continue;
      }
      if (!FileView::bytes_of(entry, parts)) missing.push_back({entry.offset, entry.stored_bytes});
    }
    return missing;
  });
}

Result<PagedFile> PagedFile::open_beginning(std::span<const FilePart> parts, const DecodeLimits& limits,
                                            std::optional<std::uint64_t> size) {
  return guard_memory([&] { return parse_beginning(parts, limits, size); });
}

Result<PagedFile> PagedFile::parse_beginning(std::span<const FilePart> parts, const DecodeLimits& limits,
                                             std::optional<std::uint64_t> size) {
  std::vector<FilePart> from_front{{0, beginning_of(parts)}};
  from_front.insert(from_front.end(), parts.begin(), parts.end());
  auto head = FileView::parse(from_front, size.value_or(from_front.front().bytes.size()), limits, true);
  if (!head) return tl::unexpected(head.error());
  PagedFile file;
  file.head_ = *std::move(head);
  file.head_.bytes_ = {};
  const PageContext context = context_of(file.head_);
  if (const SectionEntry* archive = file.head_.find(SectionType::archive)) {
    if (Status s = check_archive_bytes(*archive); !s) return tl::unexpected(s.error());
  }
  SectionEntry first = context.levels;
  first.stored_bytes = std::min(first.stored_bytes, kLevelsHeadBytes + kPageRecordBytes);
  auto section = FileView::bytes_of(context.levels, parts);
  if (!section) section = FileView::bytes_of(first, parts);
  if (!section) return tl::unexpected(too_short(from_front.front().bytes, file.head_.header()).error());
  if (Status s = file.read_table(*section, limits); !s) return tl::unexpected(s.error());
  for (const FilePart& part : parts) {
    if (part.offset > file.unread_table().offset) continue;
    if (Status s = file.extend(part); !s) return tl::unexpected(s.error());
  }
  if (Status s = check_decoded_bytes(context, limits, file.head_.header().file_bytes); !s)
    return tl::unexpected(s.error());
  return file;
}

FileRange PagedFile::unread_table(std::uint32_t below, std::uint64_t most) const {
  const SectionEntry& levels = *head_.find(SectionType::levels);
  std::uint64_t first = table_.n_ordered, end = table_.n_pages;
  if (below != lod::kNoPage) {
    first = table_.pages[below].first_child, end = first + table_.pages[below].n_children;
    while (first < end && table_.is_known(first)) ++first;
    if (first < end) end = table_.n_pages;
  }
  std::uint64_t next = first;
  while (next < end && next < table_.pages.size() && !table_.is_known(next) && (next - first) * kPageRecordBytes < most)
    ++next;
  if (next >= table_.pages.size()) next = end;
  return {levels.offset + kLevelsHeadBytes + first * kPageRecordBytes,
          std::min((next - first) * kPageRecordBytes, most)};
}

Status PagedFile::extend(const FilePart& part, std::uint32_t below) {
  if (is_verified_) return {};
  const FileRange unread = unread_table(below, std::max<std::uint64_t>(part.bytes.size(), 1));
  if (unread.bytes == 0) {
    return make_error(Errc::bad_value, unread.offset, "a page's child names another page as its parent");
  }
  if (part.offset > unread.offset) {
    return make_error(Errc::bad_argument, unread.offset, "bytes of the table of pages before these are missing",
                      unread.offset, part.offset);
  }
  const std::uint64_t skipped = unread.offset - part.offset;
  if (skipped >= part.bytes.size()) return {};
  const std::uint64_t bytes = std::min(unread.bytes, part.bytes.size() - skipped);
  const auto records = part.bytes.subspan(skipped, bytes / kPageRecordBytes * kPageRecordBytes);
  const SectionEntry& levels = *head_.find(SectionType::levels);
  const std::uint64_t from = (unread.offset - levels.offset - kLevelsHeadBytes) / kPageRecordBytes;
  return guard_memory([&] {
    Status extended = extend_page_table(records, context_of(head_), table_, from);
    is_verified_ = table_.n_ordered == table_.n_pages;
    return extended;
  });
}

Status PagedFile::reserve() {
  return guard_memory([&]() -> Status {
    table_.pages.reserve(table_.n_pages), table_.pages.resize(table_.n_pages);
    table_.stored.reserve(table_.n_pages), table_.stored.resize(table_.n_pages);
    return {};
  });
}

std::uint64_t PagedFile::memory_bytes() const {
  std::uint64_t bytes = sizeof *this + head_.sections_.capacity() * sizeof(SectionEntry) +
                        table_.pages.capacity() * sizeof(lod::Page) + table_.stored.capacity() * sizeof(StoredPage);
  bytes += head_.declarations_.crs.text.capacity();
  if (head_.archive_ != nullptr) bytes += detail::memory_bytes(*head_.archive_);
  if (head_.provenance_) bytes += head_.provenance_->source_name.capacity() + head_.provenance_->tool.capacity();
  return bytes;
}

std::uint64_t PagedFile::whole_memory_bytes() const {
  const std::uint64_t n = table_.n_pages;
  return memory_bytes() + (n - std::min<std::uint64_t>(n, table_.pages.capacity())) * sizeof(lod::Page) +
         (n - std::min<std::uint64_t>(n, table_.stored.capacity())) * sizeof(StoredPage);
}

std::uint32_t PagedFile::n_within(std::uint64_t file_bytes) const {
  const auto known = std::span(table_.stored).first(table_.n_ordered);
  const auto end = std::ranges::partition_point(
      known, [file_bytes](const StoredPage& page) { return page.offset + page.stored_bytes <= file_bytes; });
  return static_cast<std::uint32_t>(end - known.begin());
}

std::uint32_t PagedFile::n_pages_with_origins() const {
  const auto has_origins = [](const StoredPage& page) { return page.n_origins != 0; };
  return static_cast<std::uint32_t>(std::ranges::count_if(table_.stored, has_origins));
}

std::uint32_t PagedFile::finest_present() const {
  const std::uint32_t n = n_present();
  if (n == n_pages()) return 0;
  return table_.pages[n].level + 1;  // the first missing page is of the level below
}

std::uint64_t PagedFile::decoded_bytes(std::uint32_t page) const {
  const Header& h = head_.header();
  return page_layout(table_.pages[page].count, h.chunk_size, table_.stored[page].n_step_sets, h.sh_degree).bytes;
}

std::uint64_t PagedFile::most_decoded_bytes() const {
  const Header& h = head_.header();
  return page_layout(std::uint64_t{table_.page_chunks} * h.chunk_size, h.chunk_size, table_.page_chunks, h.sh_degree)
      .bytes;
}

std::uint64_t PagedFile::largest_decoded_bytes() const {
  std::uint64_t largest = 0;
  for (std::uint32_t i = 0; i < n_pages(); ++i) largest = std::max(largest, decoded_bytes(i));
  return largest;
}

std::span<const std::byte> PagedFile::bytes(std::uint32_t page) const {
  return head_.bytes().subspan(table_.stored[page].offset, table_.stored[page].stored_bytes);
}

PageRows PagedFile::rows(std::uint32_t page, std::span<const std::byte> decoded) const {
  const Header& h = head_.header();
  const StoredPage& s = table_.stored[page];
  const std::uint32_t n = table_.pages[page].count;
  return page_rows(decoded, page_layout(n, h.chunk_size, s.n_step_sets, h.sh_degree), n, s.scale_exponent, h.sh_degree);
}

bool PagedFile::has_source_index() const {
  return complete() && head_.find(SectionType::permutation) != nullptr;
}

std::uint64_t PagedFile::source_index(std::uint64_t i) const {
  return has_source_index() ? head_.source_index(i) : i;
}

Result<SplatCloud> read_pages(const PagedFile& file, std::span<const std::uint32_t> pages, const LoadOptions& options) {
  return guard_memory([&]() -> Result<SplatCloud> {
    std::vector<std::uint64_t> first;
    std::uint64_t n = 0;
    const std::uint32_t n_present = file.n_present();
    for (const std::uint32_t page : pages) {
      if (page >= n_present) {
        return make_error(Errc::pages_missing, file.head().bytes().size(),
                          "the end of the file is missing, and with it requested pages", file.n_pages(), n_present);
      }
      first.push_back(n);
      n += file.pages()[page].count;
    }
    SplatCloud cloud;
    cloud.resize(n, file.head().header().sh_degree);
    if (std::ranges::any_of(pages, [&](std::uint32_t page) { return file.stored(page).n_origins != 0; }))
      cloud.mean_rest.resize(3 * n);
    const unsigned threads = threads_for(n * 64, options.threads);
    std::vector<PageWorker> workers = page_workers(file, pages.size(), threads);
    const Status read = run_jobs(pages.size(), threads, [&](unsigned worker, std::uint64_t job) -> Status {
      const std::uint32_t page = pages[job];
      std::vector<float> rests;
      const auto rows = workers[worker].decode(file, page, &rests);
      if (!rows) return tl::unexpected(rows.error());
      if (options.validate) {
        if (Status s = check_page_values(file, page, *rows); !s) return s;
      }
      Splat buffer[64];
      for (std::uint32_t i = 0; i < rows->n; i += 64) {
        const auto part = std::span(buffer).first(std::min<std::uint32_t>(64, rows->n - i));
        if (Status s = read_page(file, page, *rows, i, part); !s) return s;
        for (std::size_t k = 0; k < part.size(); ++k) cloud.set(first[job] + i + k, part[k]);
      }
      std::ranges::copy(rests,
                        cloud.mean_rest.begin() + static_cast<std::ptrdiff_t>(rests.empty() ? 0 : 3 * first[job]));
      return {};
    });
    if (!read) return tl::unexpected(read.error());
    return cloud;
  });
}

Status validate(const PagedFile& file, unsigned threads) {
  return guard_memory([&]() -> Status {
    const FileView& head = file.head();
    for (const SectionEntry& s : head.sections()) {
      // Pages have their own hashes, and come first.
      if (s.type == static_cast<std::uint32_t>(SectionType::pages) || s.offset > head.bytes().size() ||
          s.stored_bytes > head.bytes().size() - s.offset) {
        continue;
      }
      if (const std::uint64_t hash = xxh3(head.stored(s)); hash != s.xxh3) {
        return make_error(Errc::checksum_mismatch, s.offset, "a section's checksum does not match", s.xxh3, hash);
      }
    }
    if (Status s = check_padding(file); !s) return s;
    const std::uint32_t n = file.n_present();
    threads = threads_for(head.header().n_gaussians * 64, threads);
    std::vector<PageWorker> workers = page_workers(file, n, threads);
    std::vector<ValueTotals> leaves(workers.size());
    const Status checked = run_jobs(n, threads, [&](unsigned worker, std::uint64_t job) -> Status {
      const auto page = static_cast<std::uint32_t>(job);
      const auto rows = workers[worker].decode(file, page);
      if (!rows) return tl::unexpected(rows.error());
      ValueTotals above;
      return check_page_rows(file, page, *rows, file.pages()[page].level == 0 ? leaves[worker] : above);
    });
    if (!checked || !file.complete()) return checked;
    // Last: the number of a damaged page says more.
    const SectionEntry& pages = *head.find(SectionType::pages);
    if (const std::uint64_t hash = xxh3(head.stored(pages)); hash != pages.xxh3) {
      return make_error(Errc::checksum_mismatch, pages.offset, "a section's checksum does not match", pages.xxh3, hash);
    }
    ValueTotals totals;
    for (const ValueTotals& part : leaves) totals.add(part);
    if (Status s = check_declarations(head, totals); !s) return s;
    return check_permutation(head);
  });
}

}  // namespace rgs
