// head_test.cpp - reading only the head of files without levels.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "checkout.hpp"
#include "edit_file.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

const fs::path kGolden = fs::path(source_dir()) / "tests/golden";

std::vector<fs::path> files_in(const fs::path& folder) {
  std::vector<fs::path> files;
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (entry.path().extension() == ".rgs") files.push_back(entry.path());
  }
  return files;
}

// Opens a head as a reader does that starts with `first_bytes`. Each range is in its own exact-size memory, which is
// freed once the head is complete.
Result<FileView> open_from(std::span<const std::byte> file, std::uint64_t first_bytes, std::uint64_t size,
                           std::uint64_t* n_read = nullptr) {
  std::vector<std::pair<std::uint64_t, Bytes>> pieces;
  const auto read = [&](FileRange range) {
    const auto bytes = file.subspan(range.offset, range.bytes);
    pieces.emplace_back(range.offset, Bytes(bytes.begin(), bytes.end()));
    pieces.back().second.shrink_to_fit();
    if (n_read != nullptr) *n_read += range.bytes;
  };
  read({0, std::min<std::uint64_t>(first_bytes, file.size())});
  for (int round = 0; round < 4; ++round) {
    std::vector<FilePart> parts;
    for (const auto& [offset, bytes] : pieces) parts.push_back({offset, bytes});
    const auto needs = FileView::head_needs(parts, size);
    if (!needs) return tl::unexpected(needs.error());
    if (needs->empty()) return FileView::open_head(parts, size);
    for (const FileRange& range : *needs) {
      REQUIRE(range.bytes <= 66 << 10);
      REQUIRE(range.offset + range.bytes <= size);
      read(range);
    }
  }
  FAIL("head_needs() does not finish");
  return make_error(Errc::internal, 0, "");
}

}  // namespace

TEST_CASE("the head of a file equals the whole file's") {
  int n_provenances = 0;
  for (const fs::path& path : files_in(kGolden)) {
    const Bytes file = read_bytes(path);
    if (has_levels(file)) continue;
    INFO(path);
    const auto whole = FileView::open(file);
    REQUIRE(whole);
    for (const std::uint64_t first : {0u, 1u, 127u, 128u, 300u, 1000u, 1u << 20}) {
      std::uint64_t n_read = 0;
      const auto head = open_from(file, first, file.size(), &n_read);
      REQUIRE(head);
      CHECK(head->header().n_gaussians == whole->header().n_gaussians);
      CHECK(head->header().sh_degree == whole->header().sh_degree);
      CHECK(head->declarations().full.max == whole->declarations().full.max);
      CHECK(head->declarations().n_source == whole->declarations().n_source);
      CHECK(head->declarations().origin == whole->declarations().origin);
      CHECK(head->sections().size() == whole->sections().size());
      CHECK(head->bytes().empty());
      REQUIRE(head->provenance().has_value() == whole->provenance().has_value());
      if (head->provenance()) {
        ++n_provenances;
        CHECK(head->provenance()->source_name == whole->provenance()->source_name);
        CHECK(head->provenance()->source_xxh3 == whole->provenance()->source_xxh3);
      }
      // The first bytes again if there were too few, the head, DECL, PROV.
      if (first < 1000) CHECK(n_read <= 2 * (128 + 16 * 64 + 8) + 256 + 8300);
    }
  }
  CHECK(n_provenances > 0);
}

TEST_CASE("a damaged head causes the whole file's error, and the payload is not read") {
  int n_heads = 0, n_payloads = 0;
  for (const fs::path& path : files_in(kGolden / "reject")) {
    const Bytes file = read_bytes(path);
    if (has_levels(file)) continue;
    INFO(path);
    const auto whole = FileView::open(file);
    for (const std::uint64_t first : {0u, 128u, 1u << 20}) {
      const auto head = open_from(file, first, file.size());
      if (head) {
        ++n_payloads;
        continue;
      }
      ++n_heads;
      REQUIRE_FALSE(whole);
      CHECK(head.error().code == whole.error().code);
      CHECK(head.error().offset == whole.error().offset);
    }
  }
  CHECK(n_heads > 100);
  CHECK(n_payloads > 100);
}

TEST_CASE("the head of a file that is shorter or longer than declared is refused") {
  const Bytes file = read_bytes(kGolden / "packed_degree3.rgs");
  const auto shorter = open_from(file, 4096, file.size() - 1);
  REQUIRE_FALSE(shorter);
  CHECK(shorter.error().code == Errc::truncated);
  CHECK(shorter.error().offset == file.size() - 1);
  const auto longer = open_from(file, 4096, file.size() + 1);
  REQUIRE_FALSE(longer);
  CHECK(longer.error().code == Errc::trailing_bytes);
  CHECK(longer.error().offset == file.size());
  for (std::uint64_t size = 0; size < 1000; ++size) {
    const auto cut = open_from(std::span(file).first(size), size, size);
    REQUIRE_FALSE(cut);
    CHECK(cut.error().code == Errc::truncated);
    CHECK(cut.error().offset == size);
  }
}

TEST_CASE("open_head() without the provenance has none") {
  const Bytes full = read_bytes(kGolden / "packed_degree3.rgs");
  const auto whole = FileView::open(full);
  REQUIRE(whole);
  REQUIRE(whole->provenance());
  const SectionEntry *decl = whole->find(SectionType::declarations), *prov = whole->find(SectionType::provenance);
  const std::span<const std::byte> head = std::span(full).first(std::min(decl->offset, prov->offset));
  const FilePart parts[] = {{0, head}, {decl->offset, std::span(full).subspan(decl->offset, decl->stored_bytes)}};
  const auto without_provenance = FileView::open_head(parts, full.size());
  REQUIRE(without_provenance);
  CHECK_FALSE(without_provenance->provenance());
  CHECK(FileView::head_needs(parts, full.size())->size() == 1);
}

TEST_CASE("open_head() without the bytes that head_needs() requests is an error") {
  const Bytes file = read_bytes(kGolden / "degree3.rgs");
  for (std::uint64_t first = 0; first < 900; first += 7) {
    const Bytes beginning(file.begin(), file.begin() + static_cast<std::ptrdiff_t>(first));
    const FilePart part{0, beginning};
    const auto needs = FileView::head_needs({&part, 1}, file.size());
    REQUIRE(needs);
    const auto head = FileView::open_head({&part, 1}, file.size());
    // Provenance is not required.
    if (!head) {
      CHECK(head.error().code == Errc::truncated);
      CHECK_FALSE(needs->empty());
    }
  }
  const Bytes levels = read_bytes(kGolden / "levels_packed.rgs");
  const FilePart part{0, levels};
  const auto other = FileView::head_needs({&part, 1}, levels.size());
  REQUIRE_FALSE(other);
  CHECK(other.error().code == Errc::unsupported_feature);
}
