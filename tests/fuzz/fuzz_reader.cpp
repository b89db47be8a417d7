// fuzz_reader.cpp - arbitrary bytes as an .rgs file: open, validate, and read everything that FileView::open() accepts.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>
#include <random>

#include "edit_file.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

#if defined(RGS_LIBFUZZER)
#include "rgs_mutator.hpp"

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                               unsigned seed) {
  return rgs::fuzz::mutate_rgs(data, size, max_size, seed);
}
#endif

namespace {

// Reads all decoded attributes; false if an entry of the tables stops it.
bool read_attributes(const rgs::DirectData& data) {
  std::vector<rgs::Splat> splats(std::min<std::uint64_t>(data.size(), 100));
  std::vector<rgs::ActivatedSplat> activated(splats.size());
  for (std::uint64_t done = 0; done < data.size(); done += splats.size()) {
    const std::uint64_t count = std::min<std::uint64_t>(splats.size(), data.size() - done);
    if (!data.read(data.first() + done, std::span(splats).first(count)) ||
        !data.read(data.first() + done, std::span(activated).first(count))) {
      return false;
    }
  }
  return true;
}

// The same for a file with levels, or a prefix of one.
void read_levels(std::span<const std::byte> bytes) {
  const auto file = rgs::PagedFile::open(bytes);
  if (!file) return;
  const bool valid = rgs::validate(*file, 1).has_value();
  rgs::PageDecoder decoder(*file);
  std::vector<std::byte> memory(file->largest_decoded_bytes());
  bool read = true;
  for (std::uint32_t i = 0; i < file->n_present(); ++i) {
    const auto rows = decoder.decode(i, file->bytes(i), std::span(memory).first(file->decoded_bytes(i)));
    read = read && rows;
    if (!rows) continue;
    std::vector<rgs::Splat> splats(rows->n);
    std::vector<rgs::ActivatedSplat> activated(rows->n);
    const bool checked = rgs::check_page_values(*file, i, *rows).has_value();
    const bool page_read = rgs::read_page(*file, i, *rows, 0, std::span(splats)).has_value() &&
                           rgs::read_page(*file, i, *rows, 0, std::span(activated)).has_value();
    if (checked && !page_read) std::abort();
    read = read && page_read;
  }
  for (std::uint64_t i = 0; i < file->head().header().n_gaussians; ++i) static_cast<void>(file->source_index(i));
  const auto cut = rgs::lod::finest_cut(file->pages(), bytes.size() % 1000, file->n_present());
  const auto of_cut = rgs::read_pages(*file, cut, {.validate = false, .threads = 1});
  const auto plain = rgs::leaves_as_file(*file, {.validate = false, .threads = 1});
  const auto cloud = rgs::decode(bytes);
  if (cloud && !cloud->view().consistent()) std::abort();
  if (!valid) return;
  if (!read || !of_cut || (file->complete() && !(plain && cloud && rgs::decode(*plain)))) std::abort();
}

// An exact-size copy, freed after the call.
rgs::Status extend(rgs::PagedFile& file, std::uint64_t offset, std::span<const std::byte> bytes) {
  const std::vector<std::byte> copy(bytes.begin(), bytes.end());
  return file.extend({offset, copy});
}

// The same file or prefix, fetched in pieces cut by `seed`: the same pages, or an error.
void read_in_pieces(std::span<const std::byte> bytes, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  std::vector<std::vector<std::byte>> pieces;
  std::vector<rgs::FilePart> parts;
  const auto fetch = [&](std::uint64_t offset, std::uint64_t n) {
    if (offset > bytes.size() || n > bytes.size() - offset) return false;
    const auto range = bytes.subspan(offset, n);
    pieces.emplace_back(range.begin(), range.end());
    parts.push_back({offset, pieces.back()});
    return true;
  };
  fetch(0, random() % (bytes.size() + 1));
  const auto whole = rgs::PagedFile::open(bytes);
  for (auto needs = rgs::PagedFile::needs(parts); !needs || !needs->empty(); needs = rgs::PagedFile::needs(parts)) {
    const bool there =
        needs && std::ranges::all_of(*needs, [&](const auto& range) { return fetch(range.offset, range.bytes); });
    if (there) continue;
    if (whole || rgs::PagedFile::open_beginning(parts)) std::abort();
    return;
  }
  auto file = rgs::PagedFile::open_beginning(parts);
  if (!file && whole) std::abort();
  if (!file) return;
  pieces.clear();
  rgs::Status extended;
  while (extended && !file->is_verified()) {
    const rgs::FileRange unread = file->unread_table();
    const std::uint64_t first = unread.offset - random() % std::min<std::uint64_t>(unread.offset, 300),
                        end = std::min<std::uint64_t>(unread.offset + 112 + random() % 2000, bytes.size());
    const std::uint32_t before = file->n_pages();
    if (first >= end) break;
    extended = extend(*file, first, bytes.subspan(first, end - first));
    if (file->n_pages() < before || (!extended && file->n_pages() != before)) std::abort();
    if (extended && file->n_pages() == before) break;  // the file ends inside the table
  }
  if (whole && !file->is_verified()) std::abort();
  const auto cut = rgs::lod::finest_cut(file->pages(), bytes.size() % 1000);
  const auto drawn = rgs::lod::drawn_pages(file->pages(), {.position = {}}, 1);
  if (drawn.empty() || (file->pages().front().count <= bytes.size() % 1000 && cut.empty())) std::abort();
  if (file->memory_bytes() > file->whole_memory_bytes() || file->largest_decoded_bytes() > file->most_decoded_bytes()) {
    std::abort();
  }
  if (file->is_verified() && !rgs::lod::check_pages(file->pages(), file->head().header().chunk_size)) std::abort();
  rgs::PageDecoder decoder(*file);
  std::vector<std::byte> memory(file->largest_decoded_bytes()), expected(memory.size());
  for (std::uint32_t i = 0; i < file->n_within(bytes.size()); ++i) {
    const auto stored = bytes.subspan(file->stored(i).offset, file->stored(i).stored_bytes);
    const auto out = std::span(memory).first(file->decoded_bytes(i));
    const auto rows = decoder.decode(i, stored, out);
    if (!whole) continue;
    const auto of_whole = std::span(expected).first(whole->decoded_bytes(i));
    const bool same = rgs::PageDecoder(*whole).decode(i, whole->bytes(i), of_whole).has_value() == rows.has_value() &&
                      out.size() == of_whole.size() && (!rows || std::ranges::equal(out, of_whole));
    if (!same) std::abort();
  }
}

void read_all(std::span<const std::byte> bytes) {
  if (rgs::has_levels(bytes)) {
    read_in_pieces(bytes, rgs::xxh3(bytes));
    return read_levels(bytes);
  }
  const auto view = rgs::FileView::open(bytes);
  if (!view) return;
  const bool valid = rgs::validate(*view).has_value();
  const std::uint64_t n = view->header().n_gaussians, n_chunks = view->header().n_chunks;
  for (std::uint64_t i = 0; i < n_chunks; ++i) static_cast<void>(view->chunk(i));
  for (std::uint64_t i = 0; i < view->header().n_step_sets; ++i) static_cast<void>(view->step_set(i));
  for (std::uint64_t i = 0; i < n; ++i) static_cast<void>(view->source_index(i));
  const auto data = rgs::load_direct(*view, {.validate = false, .threads = 1});
  const bool read = data && read_attributes(*data);
  if (n_chunks != 0) {
    const auto last = rgs::read_chunks(*view, n_chunks - 1, 1, {.validate = false, .threads = 1});
    if (last) static_cast<void>(read_attributes(*last));
  }
  const auto cloud = rgs::decode(bytes);
  if (cloud && !cloud->view().consistent()) std::abort();
  // Documented: after validate() none of this can fail.
  if (valid && !(read && cloud && rgs::load_direct(*view, {.threads = 1}))) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto bytes = std::as_bytes(std::span(data, size));
  read_all(bytes);
  // Checksums stop every mutation: repeat with corrected hashes and, mostly, size.
  rgs::test::Bytes fixed(bytes.begin(), bytes.end());
  if (size >= 24 && size % 8 != 0) rgs::test::put<std::uint64_t>(fixed, 16, size);  // otherwise the end may be missing
  rgs::test::fix_hashes(fixed);
  read_all(fixed);
  return 0;
}
