// beginning_test.cpp - opening files with levels before their whole table of pages has arrived.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <functional>
#include <optional>
#include <random>
#include <string>

#include "checkout.hpp"
#include "complexity.hpp"
#include "edit_file.hpp"
#include "golden_files.hpp"
#include "golden_levels.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

// The parts read of a file, each in its own exact-size memory, so that ASan detects overreads and use after free.
class Fetched {
 public:
  explicit Fetched(std::span<const std::byte> file) : file_(file) {}
  void read(FileRange range) {
    const auto bytes = file_.subspan(range.offset, range.bytes);
    pieces_.push_back({range.offset, Bytes(bytes.begin(), bytes.end())});
    pieces_.back().second.shrink_to_fit();
  }
  std::vector<FilePart> parts() const {
    std::vector<FilePart> parts;
    for (const auto& [offset, bytes] : pieces_) parts.push_back({offset, bytes});
    return parts;
  }

 private:
  std::span<const std::byte> file_;
  std::vector<std::pair<std::uint64_t, Bytes>> pieces_;
};

// Opens a file as a streaming reader does that has read the first bytes.
Result<PagedFile> open_from(std::span<const std::byte> file, std::uint64_t first_bytes, std::size_t* n_more = nullptr) {
  Fetched fetched(file);
  fetched.read({0, first_bytes});
  for (int round = 0; round < 4; ++round) {
    const auto needs = PagedFile::needs(fetched.parts(), {}, file.size());
    if (!needs) return tl::unexpected(needs.error());
    if (needs->empty()) {
      if (n_more != nullptr) *n_more = fetched.parts().size() - 1;
      return PagedFile::open_beginning(fetched.parts(), {}, file.size());
    }
    REQUIRE_FALSE(PagedFile::open_beginning(fetched.parts(), {}, file.size()));
    for (const FileRange& range : *needs) {
      if (range.offset > file.size() || range.bytes > file.size() - range.offset) {
        return make_error(Errc::truncated, file.size(), "the end is missing");
      }
      fetched.read(range);
    }
  }
  FAIL("needs() does not finish");
  return make_error(Errc::internal, 0, "");
}

Status extend(PagedFile& file, std::span<const std::byte> bytes, std::uint64_t first, std::uint64_t end) {
  const auto part = bytes.subspan(first, end - first);
  Bytes copy(part.begin(), part.end());
  copy.shrink_to_fit();
  return file.extend({first, copy});
}

bool is_known(const PagedFile& file, std::uint64_t page) {
  return page < file.pages().size() && file.pages()[page].count > 0;
}

// Reads some of the table below a random page of those whose children are not all known.
Status extend_anywhere(PagedFile& file, std::span<const std::byte> bytes, SplitMix& random) {
  std::vector<std::uint32_t> above;
  for (std::uint32_t i = 0; i < file.pages().size(); ++i) {
    const lod::Page& page = file.pages()[i];
    if (page.n_children > 0 && !is_known(file, page.first_child + page.n_children - 1)) above.push_back(i);
  }
  if (above.empty()) return make_error(Errc::internal, 0, "some page's children name another page as their parent");
  const std::uint32_t page = above[random.below(above.size())];
  const FileRange unread = file.unread_table(page, 112 + random.below(900));
  const auto part = bytes.subspan(unread.offset, unread.bytes);
  Bytes copy(part.begin(), part.end());
  copy.shrink_to_fit();
  return file.extend({unread.offset, copy}, page);
}

void check_same_page(const PagedFile& a, const PagedFile& b, std::uint32_t i) {
  const lod::Page &p = a.pages()[i], &q = b.pages()[i];
  CHECK(p.level == q.level);
  CHECK(p.parent == q.parent);
  CHECK(p.first_child == q.first_child);
  CHECK(p.n_children == q.n_children);
  CHECK(p.first == q.first);
  CHECK(p.count == q.count);
  CHECK(p.error == q.error);
  CHECK(p.bounds.min == q.bounds.min);
  CHECK(p.bounds.max == q.bounds.max);
  CHECK(p.core.min == q.core.min);
  CHECK(p.core.max == q.core.max);
  const StoredPage &s = a.stored(i), &t = b.stored(i);
  CHECK(s.offset == t.offset);
  CHECK(s.xxh3 == t.xxh3);
  CHECK(s.stored_bytes == t.stored_bytes);
  CHECK(s.n_step_sets == t.n_step_sets);
  CHECK(s.scale_exponent == t.scale_exponent);
  CHECK(s.corner == t.corner);
}

// A prefix declares what the whole file does, and can be drawn.
void check_prefix(const PagedFile& beginning, const PagedFile& whole) {
  const std::uint32_t n = beginning.n_pages();
  REQUIRE(n >= 1);
  REQUIRE(n <= whole.n_pages());
  CHECK(beginning.n_pages_in_all() == whole.n_pages());
  CHECK(beginning.n_levels() == whole.n_levels());
  CHECK(beginning.n_stored() == whole.n_stored());
  CHECK(beginning.page_chunks() == whole.page_chunks());
  CHECK(beginning.quality_db() == whole.quality_db());
  CHECK(beginning.codec() == whole.codec());
  CHECK(beginning.is_verified() == (n == whole.n_pages()));
  CHECK((beginning.unread_table().bytes == 0) == (n == whole.n_pages()));
  CHECK(beginning.n_present() == 0);
  CHECK_FALSE(beginning.complete());
  for (std::uint32_t i = 0; i < n; ++i) check_same_page(beginning, whole, i);
  for (const float detail : {0.f, 1.f, 30.f}) {
    const lod::Eye eye{{0.1, -2, 0.3}, 500, 0.01};
    CHECK(lod::drawn_pages(beginning.pages(), eye, detail) == lod::drawn_pages(whole.pages(), eye, detail, n));
  }
  for (const std::uint64_t most : {10u, 60u, 150u, 10'000u}) {
    CHECK(lod::finest_cut(beginning.pages(), most) == lod::finest_cut(whole.pages(), most, n));
  }
  CHECK(beginning.memory_bytes() <= beginning.whole_memory_bytes());
}

std::uint64_t table_end(std::span<const std::byte> bytes) {
  const std::uint64_t entry = entry_of(bytes, "LODS");
  return get<std::uint64_t>(bytes, entry + 16) + get<std::uint64_t>(bytes, entry + 24);
}

void fix_head_hash(Bytes& bytes) {
  const std::uint64_t end = entry_at(get<std::uint32_t>(bytes, 52));
  put(std::span(bytes), end, xxh3(std::span<const std::byte>(bytes).first(end)));
}

// Many pages of one chunk of 32.
Bytes many_pages(std::uint64_t n) {
  SplitMix random(71);
  const SplatCloud cloud = random_cloud(n, 0, random);
  EncodeOptions options;
  options.profile = Profile::direct;
  options.chunk_size = 32;
  options.order = Order::input;
  Bytes bytes;
  REQUIRE(write_levels(trivial_levels(cloud, {.chunk_size = 32, .page_chunks = 1}), options, bytes));
  return bytes;
}

}  // namespace

TEST_CASE("a file opens from any prefix to the pages whose records are complete, and extends to the whole") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    CAPTURE(scene.name);
    const Bytes bytes = file_of(scene);
    const auto whole = PagedFile::open(bytes);
    REQUIRE(whole);
    const std::uint64_t levels = section_of(bytes, "LODS"), end = table_end(bytes);
    for (std::uint64_t cut = 0; cut <= section_of(bytes, "PAGE"); ++cut) {
      CAPTURE(cut);
      std::size_t n_more = 0;
      auto file = open_from(bytes, cut, &n_more);
      REQUIRE(file);
      if (cut >= levels + 176 && scene.options.profile != Profile::archive) CHECK(n_more == 0);
      CHECK(n_more <= 5);  // header, table of sections, DECL, LODS, ARCH
      const std::uint64_t there = std::min(std::max(cut, levels + 176), end);
      CHECK(file->n_pages() == (there - levels - 64) / 112);
      check_prefix(*file, *whole);
      REQUIRE(extend(*file, bytes, 0, end));
      CHECK(file->is_verified());
      check_prefix(*file, *whole);
    }
  }
}

TEST_CASE("a table that arrives in pieces of any size equals the whole one") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    CAPTURE(scene.name);
    const Bytes bytes = file_of(scene);
    const auto whole = PagedFile::open(bytes);
    REQUIRE(whole);
    for (std::uint64_t seed = 0; seed < 30; ++seed) {
      CAPTURE(seed);
      SplitMix random(seed);
      auto file = open_from(bytes, 700 + random.below(500));
      REQUIRE(file);
      if (seed % 3 == 0) REQUIRE(file->reserve());
      const lod::Page* const place = file->pages().data();
      const std::uint64_t most = seed % 2 == 0 ? 200 : 2000;
      while (!file->is_verified()) {
        const FileRange unread = file->unread_table();
        REQUIRE(unread.offset + unread.bytes == table_end(bytes));
        const std::uint32_t before = file->n_pages();
        const std::uint64_t first = unread.offset - random.below(300), to = unread.offset + random.below(most);
        REQUIRE(extend(*file, bytes, first, std::min<std::uint64_t>(to, bytes.size())));
        CHECK(file->n_pages() >= before);
        check_prefix(*file, *whole);
        CHECK(extend(*file, bytes, 0, unread.offset));  // nothing new
      }
      if (seed % 3 == 0) CHECK(file->pages().data() == place);
      CHECK(file->n_within(bytes.size()) == file->n_pages());
      CHECK(file->n_within(file->stored(0).offset + file->stored(0).stored_bytes) == 1);
      CHECK(file->n_within(file->stored(0).offset) == 0);
      CHECK(extend(*file, bytes, 0, bytes.size()));  // it requests nothing more
    }
  }
}

TEST_CASE("a table that is read below any known page, in any order, equals the whole one") {
  std::vector<Bytes> files{many_pages(3000), many_pages(9000)};
  for (const GoldenLevels& scene : all_golden_levels()) files.push_back(file_of(scene));
  std::size_t n_gaps = 0;
  for (const Bytes& bytes : files) {
    const auto whole = PagedFile::open(bytes);
    REQUIRE(whole);
    for (std::uint64_t seed = 0; seed < 10; ++seed) {
      CAPTURE(seed);
      SplitMix random(seed);
      auto file = open_from(bytes, section_of(bytes, "LODS") + 64 + 112 * (1 + random.below(5)));
      REQUIRE(file);
      REQUIRE(file->reserve());
      REQUIRE(file->pages().size() == whole->n_pages());
      while (!file->is_verified()) {
        REQUIRE(extend_anywhere(*file, bytes, random));
        std::uint32_t n_known = 0;
        for (const lod::Page& page : file->pages()) n_known += page.count > 0;
        n_gaps += n_known > file->n_pages();
        CHECK(file->is_verified() == (n_known == whole->n_pages()));
        CHECK(file->unread_table().bytes <= (whole->n_pages() - n_known) * 112);
        // What is drawn is known, and as fine as it can be.
        for (const std::uint32_t page : lod::drawn_pages(file->pages(), {{0.1, -2, 0.3}, 500, 0.01}, 0)) {
          CHECK(is_known(*file, page));
          const lod::Page& drawn = file->pages()[page];
          CHECK((drawn.level == 0 || !is_known(*file, drawn.first_child + drawn.n_children - 1)));
        }
        CHECK(lod::finest_cut(file->pages(), bytes.size()).size() >= 1);
      }
      check_prefix(*file, *whole);
    }
  }
  CHECK(n_gaps > 100);
}

TEST_CASE("pages of a prefix decode from ranges of the file alone") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    CAPTURE(scene.name);
    const Bytes bytes = file_of(scene);
    const auto whole = PagedFile::open(bytes);
    auto file = open_from(bytes, section_of(bytes, "LODS") + 64 + 112);
    REQUIRE(whole);
    REQUIRE(file);
    CHECK(file->n_pages() == 1);
    CHECK((file->head().archive() != nullptr) == (scene.options.profile == Profile::archive));
    CHECK(file->head().declarations().origin == whole->head().declarations().origin);
    CHECK(file->head().bytes().empty());
    CHECK_FALSE(file->has_source_index());
    PageDecoder decoder(*file), of_whole(*whole);
    for (std::uint32_t i = 0; i < whole->n_pages(); ++i) {
      if (i == file->n_pages()) REQUIRE(extend(*file, bytes, file->unread_table().offset, table_end(bytes)));
      const std::uint64_t n = file->decoded_bytes(i);
      REQUIRE(n == whole->decoded_bytes(i));
      CHECK(n <= file->most_decoded_bytes());
      Bytes out(n), expected(n);
      const auto stored = std::span(bytes).subspan(file->stored(i).offset, file->stored(i).stored_bytes);
      const auto rows = decoder.decode(i, Bytes(stored.begin(), stored.end()), out);
      REQUIRE(rows);
      REQUIRE(of_whole.decode(i, whole->bytes(i), expected));
      CHECK(out == expected);
      CHECK(check_page_values(*file, i, *rows));
      std::vector<Splat> splats(rows->n);
      CHECK(read_page(*file, i, *rows, 0, splats));
      CHECK(file->rows(i, out).means.size() == rows->means.size());
    }
    // Nothing is present that is not in memory.
    CHECK(validate(*file));
    const std::uint32_t root = 0;
    CHECK(read_pages(*file, {&root, 1}).error().code == Errc::pages_missing);
    CHECK(leaves_as_file(*file).error().code == Errc::pages_missing);
  }
}

TEST_CASE("sections before the pages may be in any order") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 72);
  const Bytes bytes = encode_levels(scene);
  Bytes other = bytes;  // LODS, then DECL
  const std::uint64_t declarations = entry_of(bytes, "DECL"), levels = entry_of(bytes, "LODS");
  REQUIRE(levels == declarations + 64);
  std::copy_n(bytes.begin() + static_cast<std::ptrdiff_t>(levels), 64,
              other.begin() + static_cast<std::ptrdiff_t>(declarations));
  std::copy_n(bytes.begin() + static_cast<std::ptrdiff_t>(declarations), 64,
              other.begin() + static_cast<std::ptrdiff_t>(levels));
  const auto size = get<std::uint64_t>(bytes, levels + 24), first = section_of(bytes, "DECL");
  const std::uint64_t next = (first + size + 255) / 256 * 256;
  put(std::span(other), declarations + 16, first);
  put(std::span(other), levels + 16, next);
  std::fill(other.begin() + static_cast<std::ptrdiff_t>(first),
            other.begin() + static_cast<std::ptrdiff_t>(section_of(bytes, "PROV")), std::byte{0});
  std::memcpy(&other[first], &bytes[section_of(bytes, "LODS")], size);
  std::memcpy(&other[next], &bytes[first], get<std::uint64_t>(bytes, declarations + 24));
  fix_head_hash(other);
  const auto whole = PagedFile::open(other);
  REQUIRE(whole);
  for (std::uint64_t cut = 0; cut < other.size(); cut += 13) {
    CAPTURE(cut);
    auto file = open_from(other, cut);
    REQUIRE(file);
    check_prefix(*file, *whole);
    REQUIRE(extend(*file, other, file->unread_table().offset, table_end(other)));
    check_prefix(*file, *whole);
  }
}

TEST_CASE("a changed byte of the table is found at the latest when the table is complete") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const GoldenLevels scene = golden_levels("", profile, 300, 0, 73);
    const Bytes sound = encode_levels(scene);
    const auto whole = PagedFile::open(sound);
    REQUIRE(whole);
    const std::uint64_t levels = section_of(sound, "LODS"), end = table_end(sound);
    std::size_t n_at_once = 0, n_early = 0, n_late = 0;
    for (std::uint64_t i = levels; i < end; ++i) {
      CAPTURE(i - levels);
      Bytes bytes = sound;
      bytes[i] ^= std::byte{0x10};
      auto file = open_from(bytes, levels + 64 + 112 * 3 + 50);
      if (!file) {
        CHECK(i < levels + 64 + 112 * 3);
        ++n_at_once;
        continue;
      }
      std::optional<Error> error;
      while (!file->is_verified() && !error) {
        const std::uint32_t before = file->n_pages();
        const std::uint64_t from = file->unread_table().offset;
        const Status extended = extend(*file, bytes, from, std::min(from + 300, end));
        if (extended) continue;
        error = extended.error();
        CHECK(file->n_pages() == before);
        file->unread_table().bytes <= 300 ? ++n_late : ++n_early;
      }
      REQUIRE(error);
      CHECK_FALSE(file->is_verified());
      CHECK(error->offset <= sound.size());
      // The right bytes repair it, unless bytes before them were wrong.
      const bool is_last_piece = i >= file->unread_table().offset;
      const Status again = extend(*file, sound, 0, end);
      CHECK(again.has_value() == is_last_piece);
      CHECK(file->is_verified() == is_last_piece);
    }
    CHECK(n_at_once > 100);
    CHECK(n_early > 100);
    CHECK(n_late > 100);
    // Only the hash.
    Bytes bytes = sound;
    const std::uint64_t hash = entry_of(bytes, "LODS") + 40;
    put(std::span(bytes), hash, get<std::uint64_t>(bytes, hash) ^ 1);
    fix_head_hash(bytes);
    auto file = open_from(bytes, end - 1);
    REQUIRE(file);
    const Status extended = extend(*file, bytes, file->unread_table().offset, end);
    REQUIRE_FALSE(extended);
    CHECK(extended.error().code == Errc::checksum_mismatch);
    CHECK(extended.error().offset == levels);
    CHECK(file->n_pages() == whole->n_pages() - 1);
    CHECK(open_from(bytes, end).error().code == Errc::checksum_mismatch);
  }
}

TEST_CASE("errors in a table with a valid hash are found however it is read") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 700, 0, 74);
  const Bytes sound = encode_levels(scene);
  const std::uint64_t levels = section_of(sound, "LODS"), end = table_end(sound);
  std::size_t n_wrong = 0, n_right = 0;
  for (std::uint64_t i = levels; i < end; ++i) {
    for (const unsigned flip : {0x01u, 0x40u}) {
      CAPTURE(i - levels);
      CAPTURE(flip);
      Bytes bytes = sound;
      bytes[i] ^= static_cast<std::byte>(flip);
      fix_hashes(bytes);
      const auto whole = PagedFile::open(bytes);
      for (const std::uint64_t step : {std::uint64_t{112}, std::uint64_t{1000}, end}) {
        auto file = open_from(bytes, levels + 64 + 112);
        Status extended;
        if (!file) extended = tl::unexpected(file.error());
        while (extended && !file->is_verified()) {
          const std::uint64_t from = file->unread_table().offset;
          extended = extend(*file, bytes, from, std::min(from + step, end));
        }
        CHECK(extended.has_value() == whole.has_value());
        if (extended && whole) check_prefix(*file, *whole);
        if (!extended && !whole) CHECK(extended.error().offset <= bytes.size());
      }
      SplitMix random(i);
      auto file = open_from(bytes, levels + 64 + 112);
      Status extended = file ? file->reserve() : Status(tl::unexpected(file.error()));
      while (extended && !file->is_verified()) extended = extend_anywhere(*file, bytes, random);
      CHECK(extended.has_value() == whole.has_value());
      if (whole) check_prefix(*file, *whole);
      ++(whole ? n_right : n_wrong);
    }
  }
  CHECK(n_wrong > 1000);
  CHECK(n_right > 100);
}

TEST_CASE("a part of the table that is refused changes nothing, in any order") {
  const Bytes sound = many_pages(3000);
  const auto whole = PagedFile::open(sound);
  REQUIRE(whole);
  const std::uint64_t levels = section_of(sound, "LODS"), end = table_end(sound);
  std::size_t n_refused = 0;
  for (std::uint64_t i = levels + 64 + 112; i < end; i += 13) {
    CAPTURE(i - levels);
    Bytes bytes = sound;
    bytes[i] ^= std::byte{0x08};
    SplitMix random(i);
    auto file = open_from(bytes, levels + 64 + 112);
    REQUIRE(file);
    REQUIRE(file->reserve());
    for (;;) {
      std::vector<lod::Page> before = file->pages();
      const std::uint32_t n_before = file->n_pages();
      const Status extended = extend_anywhere(*file, bytes, random);
      CHECK_FALSE(file->is_verified());
      if (extended) continue;
      CHECK(file->n_pages() == n_before);
      for (std::size_t page = 0; page < before.size(); ++page) CHECK(is_known(*file, page) == (before[page].count > 0));
      break;
    }
    // The right bytes do for the rest, unless the wrong ones were taken.
    Status rest;
    while (rest && !file->is_verified()) rest = extend_anywhere(*file, sound, random);
    n_refused += file->is_verified();
    if (file->is_verified()) check_prefix(*file, *whole);
  }
  CHECK(n_refused > 100);
}

TEST_CASE("two pages cannot share children, in whatever order they are read") {
  // Of level 1 a page `late`, first of its parent's, also claims the last child of `early`, and the page behind names it.
  const Bytes sound = many_pages(9000);
  const auto whole = PagedFile::open(sound);
  REQUIRE(whole);
  const auto& pages = whole->pages();
  const auto record = [&](std::uint64_t page) { return section_of(sound, "LODS") + 64 + 112 * page; };
  std::uint32_t early = 0, late = 0;
  for (std::uint32_t i = 1; i < pages.size(); ++i) {
    if (pages[i].level != 1) continue;
    if (early == 0) early = i;
    if (i == pages[pages[i].parent].first_child && pages[i].parent > pages[early].parent + 1) late = i;
  }
  REQUIRE(late > 0);
  const std::uint32_t shared = pages[early].first_child + pages[early].n_children - 1;
  Bytes bytes = sound;
  put(std::span(bytes), record(late) + 28, shared);
  bytes[record(late) + 33] = std::byte{2};
  put(std::span(bytes), record(shared + 1) + 24, late);
  for (const std::uint64_t box : {40U, 80U}) {  // bounds and core are those of `late`
    std::copy_n(sound.begin() + static_cast<std::ptrdiff_t>(record(late) + box), 24,
                bytes.begin() + static_cast<std::ptrdiff_t>(record(shared + 1) + box));
  }
  fix_hashes(bytes);
  auto file = open_from(bytes, record(1));
  REQUIRE(file);
  REQUIRE(file->reserve());
  const auto read = [&](std::uint32_t below, std::uint64_t n) {
    const FileRange unread = file->unread_table(below, 112 * n);
    return file->extend({unread.offset, std::span<const std::byte>(bytes).subspan(unread.offset, unread.bytes)}, below);
  };
  // What is above them, and no more of their groups.
  const std::function<void(std::uint32_t)> reach = [&](std::uint32_t page) {
    if (is_known(*file, page)) return;
    reach(pages[page].parent);
    REQUIRE(read(pages[page].parent, page - pages[pages[page].parent].first_child + 1));
  };
  reach(late);
  REQUIRE_FALSE(is_known(*file, late - 1));
  reach(early);
  REQUIRE(read(early, pages[early].n_children));
  const Status shares = read(late, 1);
  REQUIRE_FALSE(shares);
  CHECK(shares.error().code == Errc::bad_value);
  CHECK(shares.error().offset == record(shared + 1) + 24);
}

TEST_CASE("one page only may claim children that are not known yet") {
  // The first of two inner pages claims children beyond the prefix that belong to the other.
  const GoldenLevels scene = golden_levels("", Profile::direct, 1200, 0, 75, 1);
  const Bytes sound = encode_levels(scene);
  const auto whole = PagedFile::open(sound);
  REQUIRE(whole);
  std::uint32_t page = 1;
  while (whole->pages()[page].level == whole->pages()[1].level) ++page;
  REQUIRE(whole->pages()[page].n_children > 1);
  Bytes bytes = sound;
  const std::uint64_t record = section_of(sound, "LODS") + 64 + 112 * page;
  put(std::span(bytes), record + 28, whole->pages()[page].first_child + 1);
  const auto file = open_from(bytes, record + 112);
  REQUIRE_FALSE(file);
  CHECK(file.error().code == Errc::bad_value);
  CHECK(file.error().offset == record + 28);
}

TEST_CASE("an invalid prefix is refused") {
  const GoldenLevels scene = golden_levels("", Profile::archive, 300, 1, 76);
  const Bytes bytes = encode_levels(scene);
  const std::uint64_t levels = section_of(bytes, "LODS");
  const auto head = [&](std::uint64_t n) { return FilePart{0, std::span(bytes).first(n)}; };
  CHECK(PagedFile::open_beginning({}).error().code == Errc::truncated);
  REQUIRE(PagedFile::needs({}));
  CHECK(PagedFile::needs({})->front().bytes == kHeaderBytes);
  const FilePart short_of_root = head(levels + 64 + 111);
  CHECK(PagedFile::open_beginning({&short_of_root, 1}).error().code == Errc::truncated);

  const std::vector<FilePart> without_tables{head(section_of(bytes, "ARCH"))};
  CHECK(PagedFile::open_beginning(without_tables).error().code == Errc::truncated);
  const auto needs = PagedFile::needs(without_tables);
  REQUIRE(needs);
  REQUIRE(needs->size() == 1);
  CHECK(needs->front().offset == section_of(bytes, "ARCH"));

  auto file = open_from(bytes, levels + 300);
  REQUIRE(file);
  const std::uint64_t next = file->unread_table().offset;
  const Status gap = extend(*file, bytes, next + 1, table_end(bytes));
  REQUIRE_FALSE(gap);
  CHECK(gap.error().code == Errc::bad_argument);
  CHECK(gap.error().offset == next);
  CHECK(extend(*file, bytes, next, table_end(bytes)));  // the caller's mistake, not the file's

  const Bytes plain = encode(scene.leaves.view(), scene.options).value();
  for (const std::uint64_t n : {std::uint64_t{1000}, std::uint64_t{plain.size()}}) {
    const FilePart part{0, std::span(plain).first(n)};
    CHECK(PagedFile::needs({&part, 1}).error().code == Errc::missing_section);
    CHECK(PagedFile::open_beginning({&part, 1}).error().code == Errc::missing_section);
  }
  const Bytes text(60, std::byte{'x'});
  const FilePart part{0, text};
  CHECK(PagedFile::needs({&part, 1}).error().code == Errc::bad_magic);

  Bytes damaged = bytes;
  damaged[section_of(bytes, "ARCH") + 200] ^= std::byte{1};
  CHECK(open_from(damaged, 600).error().code == Errc::checksum_mismatch);
  damaged = bytes;
  damaged[section_of(bytes, "DECL")] ^= std::byte{1};
  CHECK(open_from(damaged, 600).error().code == Errc::checksum_mismatch);
}

TEST_CASE("a file that declares much takes memory only for what has arrived") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 77);
  Bytes bytes = encode_levels(scene);
  // 2^32 - 2 pages in a table of 480 GB; the sections behind it move along.
  const std::uint64_t n_pages = 0xFFFFFFFE, levels = entry_of(bytes, "LODS"), at = section_of(bytes, "LODS");
  const std::uint64_t table_bytes = 64 + 112 * n_pages;
  const auto old_first = section_of(bytes, "PAGE");
  put(std::span(bytes), at, static_cast<std::uint32_t>(n_pages));
  put(std::span(bytes), levels + 24, table_bytes);
  put(std::span(bytes), levels + 32, table_bytes);
  std::uint64_t end = at + table_bytes;
  for (const char* type : {"PROV", "PAGE", "PERM"}) {
    const std::uint64_t entry = entry_of(bytes, type), start = (end + 255) / 256 * 256;
    put(std::span(bytes), entry + 16, start);
    end = start + get<std::uint64_t>(bytes, entry + 24);
  }
  put(std::span(bytes), 16, end);
  fix_head_hash(bytes);
  for (std::uint64_t record = at + 64; record + 112 <= old_first; record += 112) {
    const auto offset = get<std::uint64_t>(bytes, record);
    if (offset != 0) put(std::span(bytes), record, offset - old_first + section_of(bytes, "PAGE"));
  }
  const FilePart part{0, std::span<const std::byte>(bytes).first(at + 64 + 112 * 2)};
  const auto file = PagedFile::open_beginning({&part, 1});
  REQUIRE(file);
  CHECK(file->n_pages() == 2);
  CHECK(file->n_pages_in_all() == n_pages);
  CHECK(file->memory_bytes() < 10'000);
  CHECK(file->whole_memory_bytes() > 120 * (n_pages - 2));

  // An ARCH too large to fetch.
  const GoldenLevels archive = golden_levels("", Profile::archive, 300, 1, 78);
  bytes = encode_levels(archive);
  const std::uint64_t entry = entry_of(bytes, "ARCH");
  const std::uint64_t more = std::uint64_t{1} << 30;
  put(std::span(bytes), entry + 24, get<std::uint64_t>(bytes, entry + 24) + more);
  put(std::span(bytes), entry + 32, get<std::uint64_t>(bytes, entry + 32) + more);
  for (const char* type : {"PROV", "PAGE", "PERM"}) {
    put(std::span(bytes), entry_of(bytes, type) + 16, section_of(bytes, type) + more);
  }
  put(std::span(bytes), 16, get<std::uint64_t>(bytes, 16) + more);
  fix_head_hash(bytes);
  const auto refused = open_from(bytes, 2000);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
}

TEST_CASE("limits hold for a prefix") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 79);
  const Bytes bytes = encode_levels(scene);
  const FilePart part{0, std::span(bytes).first(section_of(bytes, "LODS") + 64 + 112)};
  DecodeLimits limits;
  limits.max_gaussians = scene.levels.splats.size();
  CHECK(PagedFile::open_beginning({&part, 1}, limits));
  --limits.max_gaussians;
  CHECK(PagedFile::open_beginning({&part, 1}, limits).error().code == Errc::limit_exceeded);
  limits = {};
  limits.max_decoded_bytes = 10'000;
  const auto refused = PagedFile::open_beginning({&part, 1}, limits);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
  CHECK(refused.error().offset == entry_of(bytes, "PAGE") + 32);
  limits = {};
  limits.max_file_bytes = bytes.size() - 1;
  CHECK(PagedFile::needs({&part, 1}, limits).error().code == Errc::limit_exceeded);
}

TEST_CASE("a page takes 120 bytes of memory, and never more than twice that while pages arrive") {
  CHECK(sizeof(lod::Page) + sizeof(StoredPage) == 120);
  const Bytes bytes = many_pages(20'000);
  const std::uint64_t end = table_end(bytes);
  auto file = open_from(bytes, 1000);
  REQUIRE(file);
  const std::uint64_t all = file->whole_memory_bytes(), fixed = all - 120 * std::uint64_t{file->n_pages_in_all()};
  CHECK(fixed < 3000);
  while (!file->is_verified()) {
    const std::uint64_t from = file->unread_table().offset;
    REQUIRE(extend(*file, bytes, from, std::min(from + 3000, end)));
    CHECK(file->memory_bytes() <= fixed + std::uint64_t{240} * file->n_pages());
    CHECK(file->memory_bytes() <= all);
    CHECK(file->whole_memory_bytes() == all);
  }
  CHECK(file->memory_bytes() == all);
  auto reserved = open_from(bytes, 1000);
  REQUIRE(reserved);
  REQUIRE(reserved->reserve());
  CHECK(reserved->memory_bytes() == all);
}

TEST_CASE("growth: reading a table in pieces is linear in its size") {
  const auto prepare = [](std::uint64_t n) { return many_pages(32 * n); };
  const auto work = [](const Bytes& bytes) {
    const FilePart part{0, std::span(bytes).first(section_of(bytes, "LODS") + 64 + 112)};
    auto file = PagedFile::open_beginning({&part, 1});
    REQUIRE(file);
    const std::uint64_t end = table_end(bytes);
    while (!file->is_verified()) {
      const std::uint64_t from = file->unread_table().offset, to = std::min(from + 200, end);
      REQUIRE(file->extend({from, std::span(bytes).subspan(from, to - from)}));
    }
  };
  CHECK(growth(300, prepare, work) < kLinearGrowth);
}

TEST_CASE("fuzzing seeds are valid files: others would stop at the first check") {
  for (const auto& entry : std::filesystem::directory_iterator(source_dir() + "/tests/fuzz/corpus/reader")) {
    CAPTURE(entry.path().string());
    CHECK(decode(read_bytes(entry.path())));
  }
  for (const auto& entry : std::filesystem::directory_iterator(source_dir() + "/tests/fuzz/corpus/levels")) {
    CAPTURE(entry.path().string());
    const Bytes bytes = read_bytes(entry.path());
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    CHECK(validate(*file));
  }
}

TEST_CASE("a damaged beginning is refused with the error of the whole file") {
  std::mt19937 random(31);
  int n_refused = 0, n_trailing = 0;
  for (const char* name : {"levels_direct.rgs", "levels_packed.rgs", "levels_archive.rgs", "levels_archive3.rgs"}) {
    const Bytes golden = read_bytes(std::filesystem::path(source_dir()) / "tests/golden" / name);
    const std::uint64_t pages = section_of(golden, "PAGE");
    for (int i = 0; i < 2000; ++i) {
      Bytes file = golden;
      // Every eighth states another size of the file; the others change a byte before the pages.
      const std::uint64_t at = random() % 8 == 0 ? 16 + random() % 2 : random() % pages;
      file[at] ^= static_cast<std::byte>(1U << random() % 8);
      if (random() % 4 != 0) fix_hashes(file);
      const auto whole = PagedFile::open(file);
      const auto beginning = open_from(file, pages);
      if (beginning) continue;
      CAPTURE(name);
      CAPTURE(at);
      REQUIRE_FALSE(whole);
      // A beginning does not have the padding behind the pages.
      if (whole.error().code == Errc::section_gap && whole.error().offset > pages) continue;
      CHECK(std::string(errc_name(beginning.error().code)) == errc_name(whole.error().code));
      CHECK(beginning.error().offset == whole.error().offset);
      ++n_refused;
      n_trailing += whole.error().code == Errc::trailing_bytes ? 1 : 0;
    }
  }
  CHECK(n_refused > 2000);
  CHECK(n_trailing > 20);
}
