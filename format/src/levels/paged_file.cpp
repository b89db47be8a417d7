// paged_file.cpp - opens files with levels of detail, and reads and checks all of their pages.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/paged_file.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include "file/layout_io.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "levels/page_table.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {

using namespace detail;

namespace {

// What one thread needs to decode pages.
struct PageWorker {
  PageWorker(const PagedFile& file, std::uint64_t largest) : decoder(file), memory(largest) {}
  PageDecoder decoder;
  std::vector<std::byte> memory;

  Result<PageRows> decode(const PagedFile& file, std::uint32_t page) {
    return decoder.decode(page, file.bytes(page), std::span(memory).first(file.decoded_bytes(page)));
  }
};

std::vector<PageWorker> page_workers(const PagedFile& file, std::uint64_t n_pages, unsigned threads) {
  std::vector<PageWorker> workers;
  const std::uint64_t largest = file.largest_decoded_bytes();
  for (unsigned i = worker_count(n_pages, threads); i > 0; --i) workers.emplace_back(file, largest);
  return workers;
}

// What lies between pages that are stored as they are.
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

}  // namespace

bool has_levels(std::span<const std::byte> bytes) {
  const auto header = parse_header(bytes);
  if (!header || header->version_minor < 4) return false;
  for (std::uint32_t i = 0; i < header->n_sections; ++i) {
    const std::uint64_t at = section_entry_offset(i);
    if (at > bytes.size() || bytes.size() - at < kSectionEntryBytes) return false;
    const std::uint32_t type = ByteReader(bytes.subspan(at)).u32();
    if (type == static_cast<std::uint32_t>(SectionType::levels)) return true;
  }
  return false;
}

Result<PagedFile> PagedFile::open(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  return guard_memory([&] { return parse(bytes, limits); });
}

Result<PagedFile> PagedFile::parse(std::span<const std::byte> bytes, const DecodeLimits& limits) {
  auto head = FileView::parse(bytes, limits, true);
  if (!head) return tl::unexpected(head.error());
  const SectionEntry* levels = head->find(SectionType::levels);
  const SectionEntry* pages = head->find(SectionType::pages);
  if (levels == nullptr || pages == nullptr) {
    return make_error(Errc::missing_section, kHeaderBytes, "the file has no levels of detail",
                      static_cast<std::uint64_t>(SectionType::levels));
  }
  if (levels->offset > bytes.size() || levels->stored_bytes > bytes.size() - levels->offset) {
    return make_error(Errc::truncated, bytes.size(), "the file ends before its first page", head->header().file_bytes,
                      bytes.size());
  }
  const auto table_bytes = head->stored(*levels);
  if (const std::uint64_t hash = xxh3(table_bytes); hash != levels->xxh3) {
    return make_error(Errc::checksum_mismatch, levels->offset, "a section's checksum does not match", levels->xxh3,
                      hash);
  }
  const auto entry_of = [&](const SectionEntry* entry) {
    return section_entry_offset(static_cast<std::uint64_t>(entry - head->sections().data()));
  };
  const std::uint64_t pages_entry = entry_of(pages);
  auto table = parse_page_table(table_bytes, {head->header(), *levels, *pages, entry_of(levels), pages_entry}, limits,
                                head->header().file_bytes);
  if (!table) return tl::unexpected(table.error());
  PagedFile file;
  file.codec_ = static_cast<Codec>(pages->codec);
  file.pages_ = std::move(table->pages);
  file.stored_ = std::move(table->stored);
  file.n_stored_ = table->n_stored;
  file.page_chunks_ = table->page_chunks;
  file.quality_db_ = table->quality_db;
  file.head_ = *std::move(head);
  if (file.codec_ != Codec::none && !file.complete()) {
    // What file_bytes allows counts bytes that are not there.
    std::uint64_t decoded = 0;
    const std::uint32_t n = file.n_present();
    for (std::uint32_t i = 0; i < n; ++i) decoded += file.decoded_bytes(i);
    if (decoded > limits.decoded_bytes(bytes.size())) {
      return make_error(Errc::limit_exceeded, pages_entry + 32,
                        "pages decode to more than the caller allows for so many bytes (max_expansion)",
                        limits.decoded_bytes(bytes.size()), decoded);
    }
  }
  return file;
}

std::uint32_t PagedFile::n_present() const {
  const std::uint64_t size = head_.bytes().size();
  const auto end = std::ranges::partition_point(
      stored_, [size](const StoredPage& page) { return page.offset + page.stored_bytes <= size; });
  return static_cast<std::uint32_t>(end - stored_.begin());
}

std::uint32_t PagedFile::finest_present() const {
  const std::uint32_t n = n_present();
  if (n == n_pages()) return 0;
  return pages_[n].level + 1;  // the first page that is missing is of the level below
}

std::uint64_t PagedFile::decoded_bytes(std::uint32_t page) const {
  const Header& h = head_.header();
  return page_layout(pages_[page].count, h.chunk_size, stored_[page].n_step_sets, h.sh_degree).bytes;
}

std::uint64_t PagedFile::largest_decoded_bytes() const {
  std::uint64_t largest = 0;
  for (std::uint32_t i = 0; i < n_pages(); ++i) largest = std::max(largest, decoded_bytes(i));
  return largest;
}

std::span<const std::byte> PagedFile::bytes(std::uint32_t page) const {
  return head_.bytes().subspan(stored_[page].offset, stored_[page].stored_bytes);
}

PageRows PagedFile::rows(std::uint32_t page, std::span<const std::byte> decoded) const {
  const Header& h = head_.header();
  const StoredPage& s = stored_[page];
  const std::uint32_t n = pages_[page].count;
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
                          "the end of the file is missing, and with it pages that are asked for", file.n_pages(),
                          n_present);
      }
      first.push_back(n);
      n += file.pages()[page].count;
    }
    SplatCloud cloud;
    cloud.resize(n, file.head().header().sh_degree);
    const unsigned threads = threads_for(n * 64, options.threads);
    std::vector<PageWorker> workers = page_workers(file, pages.size(), threads);
    const Status read = run_jobs(pages.size(), threads, [&](unsigned worker, std::uint64_t job) -> Status {
      const std::uint32_t page = pages[job];
      const auto rows = workers[worker].decode(file, page);
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
    // Last: which page is damaged says more.
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
