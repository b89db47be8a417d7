// rgs_mutator.hpp - structural mutations of .rgs files: fields, counts, sections, frames, pages and their contents
// change, then sizes, offsets and hashes are corrected, so that readers reach the change.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <zstd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <optional>
#include <random>
#include <span>
#include <utility>
#include <vector>

#include "edit_file.hpp"
#include "rgs/layout.hpp"

extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t max_size);

namespace rgs::fuzz {

using test::Bytes;
using test::get;
using test::put;

class RgsMutator {
 public:
  explicit RgsMutator(unsigned seed) : random_(seed) {}

  /// Replaces `bytes` by a mutated file; by nothing if they are too short, or the result exceeds `max_size`.
  std::optional<Bytes> mutate(std::span<const std::byte> bytes, std::size_t max_size) {
    if (!take_apart(bytes)) return {};
    for (std::uint64_t i = 1 + below(3); i > 0; --i) change();
    Bytes file = put_together();
    if (file.size() > max_size) return {};
    return file;
  }

 private:
  struct Section {
    Bytes entry, content;
    std::uint32_t codec() const { return get<std::uint32_t>(entry, 8); }
  };

  std::uint64_t below(std::uint64_t n) { return random_() % n; }

  bool take_apart(std::span<const std::byte> bytes) {
    if (bytes.size() < 128) return false;
    header_.assign(bytes.begin(), bytes.begin() + 128);
    const std::uint64_t n = get<std::uint32_t>(bytes, 52);
    if (n == 0 || n > 64 || n > (bytes.size() - 128) / 64) return false;
    for (std::uint64_t i = 0; i < n; ++i) {
      const auto entry = bytes.subspan(test::entry_at(i), 64);
      const auto offset = std::min<std::uint64_t>(get<std::uint64_t>(entry, 16), bytes.size());
      const auto content =
          bytes.subspan(offset, std::min<std::uint64_t>(get<std::uint64_t>(entry, 24), bytes.size() - offset));
      sections_.push_back({{entry.begin(), entry.end()}, {content.begin(), content.end()}});
    }
    if (const Section* pages = section("PAGE")) move_pages(0 - get<std::uint64_t>(pages->entry, 16));
    return true;
  }

  // Corrects offsets, sizes and hashes; decoded sizes only of sections stored as they are.
  Bytes put_together() {
    put(std::span(header_), 52, static_cast<std::uint32_t>(sections_.size()));
    std::uint64_t end = test::entry_at(sections_.size()) + 8;
    for (Section& s : sections_) {
      const std::uint64_t offset = (end + 255) / 256 * 256;
      put(std::span(s.entry), 16, offset);
      put(std::span(s.entry), 24, std::uint64_t{s.content.size()});
      if (s.codec() == 0) put(std::span(s.entry), 32, std::uint64_t{s.content.size()});
      end = offset + s.content.size();
    }
    if (const Section* pages = section("PAGE")) move_pages(get<std::uint64_t>(pages->entry, 16));
    put(std::span(header_), 16, end);
    Bytes file(end);
    std::ranges::copy(header_, file.begin());
    for (std::size_t i = 0; i < sections_.size(); ++i) {
      const Section& s = sections_[i];
      std::ranges::copy(s.entry, file.begin() + static_cast<std::ptrdiff_t>(test::entry_at(i)));
      std::ranges::copy(s.content, file.begin() + static_cast<std::ptrdiff_t>(get<std::uint64_t>(s.entry, 16)));
    }
    if (below(16) == 0) file.resize(file.size() - below(file.size() / 2));  // the end is missing
    test::fix_hashes(file);
    return file;
  }

  static bool is(const Section& s, const char* type) { return std::memcmp(s.entry.data(), type, 4) == 0; }

  Section* section(const char* type) {
    const auto s = std::ranges::find_if(sections_, [type](const Section& each) { return is(each, type); });
    return s == sections_.end() ? nullptr : &*s;
  }

  // Records of pages that are there.
  std::uint64_t n_pages() {
    const Section* levels = section("LODS");
    if (levels == nullptr || levels->content.size() < kLevelsHeadBytes) return 0;
    const std::uint64_t records = (levels->content.size() - kLevelsHeadBytes) / kPageRecordBytes;
    return std::min<std::uint64_t>(get<std::uint32_t>(levels->content, 0), records);
  }

  // Adds `bytes` to the offsets of pages from `first` on; they count from the beginning of PAGE while pages change.
  void move_pages(std::uint64_t bytes, std::uint64_t first = 0) {
    for (std::uint64_t i = first, n = n_pages(); i < n; ++i) {
      const std::span<std::byte> records(section("LODS")->content);
      const std::uint64_t at = kLevelsHeadBytes + kPageRecordBytes * i;
      put(records, at, get<std::uint64_t>(records, at) + bytes);
    }
  }

  void change() {
    if (below(2) == 0 && n_pages() != 0) return change_pages();
    Section& s = sections_[below(sections_.size())];
    switch (below(10)) {
      case 0: return change_number(header_, 8, 60);
      case 1: return change_number(s.entry, 0, 64);
      case 2: return change_sections();
      case 3: return change_counts();
      case 4: return resize(s.content);
      case 5: return change_frame_table(s);
      case 6:
      case 7: return change_frame(s);
      default: return change_number(s.content, 0, s.content.size());
    }
  }

  // Changes a number of 1, 2, 4 or 8 bytes somewhere in [first, end) of `bytes`: to an extreme, a neighbour, one bit
  // off, or a number from the file.
  void change_number(Bytes& bytes, std::size_t first, std::size_t end) {
    const std::size_t width = std::size_t{1} << below(4);
    if (end < first + width) return;
    const std::size_t at = first + below((end - first) / width) * width;
    std::uint64_t value = 0;
    std::memcpy(&value, bytes.data() + at, width);
    constexpr std::array<std::uint64_t, 10> kExtremes = {
        0, 1, 127, 255, 0x7C00, 0x7F800000u, 0x7FC00000, 0xFF800000, 0xFFFFFFFF, ~std::uint64_t{0}};
    switch (below(4)) {
      case 0: value = kExtremes[below(kExtremes.size())]; break;
      case 1: value += below(2) == 0 ? 1 : ~std::uint64_t{0}; break;
      case 2: value ^= std::uint64_t{1} << below(8 * width); break;
      default: value = random_();
    }
    std::memcpy(bytes.data() + at, &value, width);
  }

  // Removes or repeats an entry, swaps two, or changes a type.
  void change_sections() {
    const std::size_t a = below(sections_.size()), b = below(sections_.size());
    switch (below(3)) {
      case 0:
        if (sections_.size() > 1) sections_.erase(sections_.begin() + static_cast<std::ptrdiff_t>(a));
        return;
      case 1:
        if (sections_.size() < 12)
          sections_.insert(sections_.begin() + static_cast<std::ptrdiff_t>(b), Section(sections_[a]));
        return;
      default: std::swap(sections_[a], sections_[b]);
    }
  }

  // Changes the number of Gaussians, and the head to match.
  void change_counts() {
    const std::uint64_t n = below(3) == 0 ? below(70000) : get<std::uint64_t>(header_, 24) + below(3) - 1;
    if (below(4) == 0)
      put(std::span(header_), 48, static_cast<std::uint32_t>(32 * (1 + below(below(2) == 0 ? 16 : 2048))));
    const std::uint64_t size = std::max<std::uint64_t>(1, get<std::uint32_t>(header_, 48));
    const std::uint64_t chunks = n / size + (n % size != 0 ? 1 : 0);
    const std::uint64_t sets = get<std::uint64_t>(header_, 40) <= 1 ? std::min<std::uint64_t>(1, chunks) : chunks;
    put(std::span(header_), 24, n);
    put(std::span(header_), 32, chunks);
    put(std::span(header_), 40, sets);
    for (Section& s : sections_) {
      const std::uint64_t rows = is(s, "CHNK") ? chunks : is(s, "SHSC") ? sets : n;
      const std::uint64_t each = is(s, "CHNK") || is(s, "SHSC") ? 48
                                 : is(s, "MEAN")                ? 12
                                 : is(s, "GEOM")                ? 16
                                 : is(s, "SHI8")                ? std::to_integer<std::uint64_t>(header_[57])
                                 : is(s, "PERM")                ? 4
                                                                : 0;
      if (is(s, "DECL") && s.content.size() >= 112)
        put(std::span(s.content), 96, n + get<std::uint64_t>(s.content, 104));
      if (each == 0) continue;
      put(std::span(s.entry), 32, rows * each);
      if (s.codec() == 0 && rows < 70000) s.content.resize(rows * each);
      if (s.codec() != 0) fit_frame_count(s, rows);
    }
  }

  // Resizes a coded section's table for `rows` rows; cuts off or repeats frames.
  void fit_frame_count(Section& s, std::uint64_t rows) {
    auto frames = frames_of(s);
    if (frames.empty()) return;
    const std::uint64_t each = std::max<std::uint64_t>(1, get<std::uint32_t>(s.content, 0));
    const std::uint64_t n = std::min<std::uint64_t>((rows + each - 1) / each, 64);
    while (frames.size() < n) frames.push_back(frames.back());
    frames.resize(n);
    set_frames(s, frames);
  }

  // Changes a page's record or rows, or the same floats of all records by one factor, so that the tree still holds:
  // errors, boxes or cores.
  void change_pages() {
    const std::uint64_t n = n_pages(), page = below(n), at = kLevelsHeadBytes + kPageRecordBytes * page;
    Bytes& records = section("LODS")->content;
    switch (below(4)) {
      case 0: return change_number(records, at + 16, at + kPageRecordBytes);
      case 1: {
        constexpr std::array<std::array<std::uint64_t, 2>, 3> kFloats = {{{36, 40}, {40, 64}, {80, 104}}};
        const auto [first, end] = kFloats[below(kFloats.size())];
        const float factor = std::ldexp(1.0F, static_cast<int>(below(81)) - 40);
        for (std::uint64_t i = 0; i < n; ++i) {
          for (std::uint64_t field = first; field < end; field += 4) {
            const std::uint64_t place = kLevelsHeadBytes + kPageRecordBytes * i + field;
            put(std::span(records), place, get<float>(records, place) * factor);
          }
        }
        return;
      }
      default: return change_rows(page);
    }
  }

  // Changes a page's stored bytes; later pages move.
  void change_rows(std::uint64_t page) {
    Section* const pages = section("PAGE");
    if (pages == nullptr) return;
    const std::span<std::byte> record =
        std::span(section("LODS")->content).subspan(kLevelsHeadBytes + kPageRecordBytes * page, kPageRecordBytes);
    const auto offset = get<std::uint64_t>(record, 0), size = std::uint64_t{get<std::uint32_t>(record, 16)};
    if (offset > pages->content.size() || size > pages->content.size() - offset) return;
    const auto first = pages->content.begin() + static_cast<std::ptrdiff_t>(offset);
    const auto end = first + static_cast<std::ptrdiff_t>(size);
    Bytes rows(first, end);
    change_coded(rows, pages->codec());
    if (pages->codec() == 0) rows.resize(size);  // pages are aligned there
    put(record, 16, static_cast<std::uint32_t>(rows.size()));
    move_pages(rows.size() - size, page + 1);
    const auto next = pages->content.erase(first, end);
    pages->content.insert(next, rows.begin(), rows.end());
  }

  void resize(Bytes& content) {
    std::vector<std::uint8_t> bytes(content.size() + 256);
    std::ranges::transform(content, bytes.begin(), [](std::byte b) { return std::to_integer<std::uint8_t>(b); });
    bytes.resize(LLVMFuzzerMutate(bytes.data(), content.size(), bytes.size()));
    const auto changed = std::as_bytes(std::span(bytes));
    content.assign(changed.begin(), changed.end());
  }

  std::vector<Bytes> frames_of(const Section& s) const {
    std::vector<Bytes> frames;
    if (s.codec() < 1 || s.codec() > 3 || s.content.size() < 16) return frames;
    const std::uint64_t n = get<std::uint32_t>(s.content, 4);
    if (n > (s.content.size() - 16) / 16) return frames;
    std::uint64_t at = 16 + 16 * n;
    for (std::uint64_t i = 0; i < n; ++i) {
      const std::uint64_t size =
          std::min<std::uint64_t>(get<std::uint32_t>(s.content, 16 + 16 * i), s.content.size() - at);
      const auto frame = std::span(s.content).subspan(at, size);
      frames.emplace_back(frame.begin(), frame.end());
      at += size;
    }
    return frames;
  }

  // Hashes follow later.
  static void set_frames(Section& s, std::span<const Bytes> frames) {
    Bytes content(16 + 16 * frames.size());
    std::copy_n(s.content.begin(), 4, content.begin());
    put(std::span(content), 4, static_cast<std::uint32_t>(frames.size()));
    for (std::size_t i = 0; i < frames.size(); ++i) {
      put(std::span(content), 16 + 16 * i, static_cast<std::uint32_t>(frames[i].size()));
      content.insert(content.end(), frames[i].begin(), frames[i].end());
    }
    s.content = std::move(content);
  }

  void change_frame_table(Section& s) {
    auto frames = frames_of(s);
    if (frames.empty()) return;
    const std::size_t a = below(frames.size()), b = below(frames.size());
    switch (below(4)) {
      case 0: return change_number(s.content, 0, std::min<std::size_t>(s.content.size(), 16 + 16 * frames.size()));
      case 1: std::swap(frames[a], frames[b]); break;
      case 2: frames.erase(frames.begin() + static_cast<std::ptrdiff_t>(a)); break;
      default: frames.push_back(Bytes(frames[a])); break;
    }
    set_frames(s, frames);
  }

  void change_frame(Section& s) {
    auto frames = frames_of(s);
    if (frames.empty()) return;
    change_coded(frames[below(frames.size())], s.codec());
    set_frames(s, frames);
  }

  // Changes numbers of a Zstandard frame's content, or of bytes stored as they are; otherwise the bytes themselves.
  void change_coded(Bytes& bytes, std::uint32_t codec) {
    const unsigned long long size = codec == 1 ? ZSTD_getFrameContentSize(bytes.data(), bytes.size()) : bytes.size();
    if (codec > 1 || size == 0 || size > (1u << 20) || below(4) == 0) return resize(bytes);
    Bytes content = bytes;
    if (codec == 1) {
      content.resize(size);
      const std::size_t got = ZSTD_decompress(content.data(), content.size(), bytes.data(), bytes.size());
      if (ZSTD_isError(got) != 0 || got != size) return;
    }
    for (std::uint64_t i = 1 + below(8); i > 0; --i) change_number(content, 0, content.size());
    if (below(8) == 0) resize(content);
    if (codec == 0) return bytes.swap(content);
    bytes.resize(ZSTD_compressBound(content.size()));
    bytes.resize(ZSTD_compress(bytes.data(), bytes.size(), content.data(), content.size(), 1));
  }

  std::mt19937 random_;
  Bytes header_;
  std::vector<Section> sections_;
};

/// For LLVMFuzzerCustomMutator(): mostly structural, sometimes bytewise.
inline std::size_t mutate_rgs(std::uint8_t* data, std::size_t size, std::size_t max_size, unsigned seed) {
  if (seed % 8 != 0) {
    if (const auto file = RgsMutator(seed).mutate(std::as_bytes(std::span(data, size)), max_size)) {
      std::memcpy(data, file->data(), file->size());
      return file->size();
    }
  }
  return LLVMFuzzerMutate(data, size, max_size);
}

}  // namespace rgs::fuzz
