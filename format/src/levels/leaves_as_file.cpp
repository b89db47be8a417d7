// leaves_as_file.cpp - writes the finest level of a file with levels as a file without, in memory.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <utility>

#include "file/byte_writer.hpp"
#include "file/layout_io.hpp"
#include "file/value_checks.hpp"
#include "file/workers.hpp"
#include "levels/page_table.hpp"
#include "rgs/checksum.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/paged_file.hpp"

namespace rgs {

using namespace detail;

namespace {

SectionEntry entry_of(SectionType type, std::uint64_t bytes, bool required) {
  SectionEntry entry;
  entry.type = static_cast<std::uint32_t>(type);
  entry.flags = required ? kSectionMustUnderstand : 0;
  entry.stored_bytes = entry.decoded_bytes = bytes;
  return entry;
}

// The file's bytes, with every section in place.
class PlainFile {
 public:
  PlainFile(const Header& header, std::vector<SectionEntry> sections)
      : header_(header), sections_(std::move(sections)) {
    std::uint64_t end = section_entry_offset(sections_.size()) + kHeadChecksumBytes;
    for (SectionEntry& s : sections_) {
      s.offset = align_up(end, kSectionAlignment);
      end = s.offset + s.stored_bytes;
    }
    bytes_.resize(end);
  }
  std::span<std::byte> section(SectionType type) {
    const auto entry = std::ranges::find(sections_, static_cast<std::uint32_t>(type), &SectionEntry::type);
    return std::span(bytes_).subspan(entry->offset, entry->stored_bytes);
  }
  std::vector<std::byte> finish() {
    header_.file_bytes = bytes_.size();
    header_.n_sections = static_cast<std::uint32_t>(sections_.size());
    for (SectionEntry& s : sections_) s.xxh3 = xxh3(std::span(bytes_).subspan(s.offset, s.stored_bytes));
    std::ranges::copy(write_head(header_, sections_), bytes_.begin());
    return std::move(bytes_);
  }

 private:
  Header header_;
  std::vector<SectionEntry> sections_;
  std::vector<std::byte> bytes_;
};

}  // namespace

Result<std::vector<std::byte>> leaves_as_file(const PagedFile& file, const LoadOptions& options) {
  return guard_memory([&]() -> Result<std::vector<std::byte>> {
    const FileView& head = file.head();
    if (file.n_present() < file.n_pages()) {
      return make_error(Errc::pages_missing, head.bytes().size(),
                        "the end of the file is missing, and with it some of the scene's own Gaussians", file.n_pages(),
                        file.n_present());
    }
    Header h = head.header();
    const std::uint64_t stride = sh_bytes(h.sh_degree);
    const Declarations& d = head.declarations();
    h.version_minor = d.crs != Crs() || d.first_view != FirstView() ? 5 : d.origin != kNoOrigin ? 3 : 0;
    h.n_step_sets = h.n_chunks;  // even if pages share one
    std::vector<SectionEntry> sections{entry_of(SectionType::declarations, kDeclarationBytes, true),
                                       entry_of(SectionType::sh_steps, h.n_step_sets * kStepSetBytes, true),
                                       entry_of(SectionType::chunks, h.n_chunks * kChunkEntryBytes, true),
                                       entry_of(SectionType::means, h.n_gaussians * kMeanBytes, true),
                                       entry_of(SectionType::geometry, h.n_gaussians * kGeometryBytes, true),
                                       entry_of(SectionType::sh, h.n_gaussians * stride, true)};
    // Drops sections that are incomplete. Provenance and CRS were checked when the file was opened.
    std::vector<const SectionEntry*> kept;
    for (const SectionType type : {SectionType::permutation, SectionType::provenance, SectionType::crs}) {
      const SectionEntry* entry = head.find(type);
      if (entry == nullptr || entry->offset + entry->stored_bytes > head.bytes().size()) continue;
      if (type == SectionType::permutation && xxh3(head.stored(*entry)) != entry->xxh3) {
        return make_error(Errc::checksum_mismatch, entry->offset, "a section's checksum does not match", entry->xxh3,
                          xxh3(head.stored(*entry)));
      }
      kept.push_back(entry);
      sections.push_back(entry_of(type, entry->stored_bytes, false));
    }
    PlainFile plain(h, std::move(sections));
    std::ranges::copy(write_declarations(head.declarations()), plain.section(SectionType::declarations).begin());
    for (const SectionEntry* entry : kept) {
      std::ranges::copy(head.stored(*entry), plain.section(static_cast<SectionType>(entry->type)).begin());
    }
    const std::array arrays{plain.section(SectionType::sh_steps), plain.section(SectionType::chunks),
                            plain.section(SectionType::means), plain.section(SectionType::geometry),
                            plain.section(SectionType::sh)};
    const std::vector<std::uint32_t> leaves = lod::pages_of_level(file.pages(), 0);
    const std::uint64_t first_row = file.pages()[leaves.front()].first;
    const unsigned threads = threads_for(h.n_gaussians * (kMeanBytes + kGeometryBytes + stride), options.threads);
    std::vector<PageDecoder> decoders;
    std::vector<std::vector<std::byte>> memory;
    for (unsigned i = worker_count(leaves.size(), threads); i > 0; --i) {
      decoders.emplace_back(file);
      memory.emplace_back(file.largest_decoded_bytes());
    }
    const Status done = run_jobs(leaves.size(), threads, [&](unsigned worker, std::uint64_t job) -> Status {
      const std::uint32_t page = leaves[job];
      const auto rows =
          decoders[worker].decode(page, file.bytes(page), std::span(memory[worker]).first(file.decoded_bytes(page)));
      if (!rows) return tl::unexpected(rows.error());
      if (options.validate) {
        if (Status s = check_page_values(file, page, *rows); !s) return s;
      }
      const std::uint64_t row = file.pages()[page].first - first_row, chunk = row / h.chunk_size;
      const auto put = [](std::span<const std::byte> from, std::span<std::byte> to, std::uint64_t at) {
        std::ranges::copy(from, to.begin() + static_cast<std::ptrdiff_t>(at));
      };
      put(rows->means, arrays[2], row * kMeanBytes);
      put(rows->geometry, arrays[3], row * kGeometryBytes);
      put(rows->sh, arrays[4], row * stride);
      const bool shared = file.stored(page).n_step_sets == 1;
      ByteWriter chunks;
      for (std::uint64_t i = 0; i < chunks_of(rows->n, h.chunk_size); ++i) {
        put(rows->steps.subspan((shared ? 0 : i) * kStepSetBytes, kStepSetBytes), arrays[0],
            (chunk + i) * kStepSetBytes);
        auto entry =
            parse_chunk_entry(rows->chunks.subspan(i * kChunkEntryBytes, kChunkEntryBytes), file.stored(page).offset);
        if (!entry) return tl::unexpected(entry.error());
        entry->step_set = chunk + i;
        write_chunk_entry(chunks, *entry);
      }
      put(chunks.bytes(), arrays[1], chunk * kChunkEntryBytes);
      return {};
    });
    if (!done) return tl::unexpected(done.error());
    return plain.finish();
  });
}

}  // namespace rgs
