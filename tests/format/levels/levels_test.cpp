// levels_test.cpp - files with levels of detail: written, read page by page, cut, incomplete and damaged.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "archive_pages.hpp"
#include "edit_file.hpp"
#include "golden_files.hpp"
#include "golden_levels.hpp"
#include "random_cloud.hpp"
#include "rgs/decode.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/paged_file.hpp"
#include "trivial_levels.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

Result<PageRows> decode_page(const PagedFile& file, std::uint32_t page, Bytes& memory) {
  memory.assign(file.decoded_bytes(page), std::byte{0xA5});
  return PageDecoder(file).decode(page, file.bytes(page), memory);
}

std::vector<Splat> splats_of(const PagedFile& file, std::uint32_t page) {
  Bytes memory;
  const auto rows = decode_page(file, page, memory);
  REQUIRE(rows);
  std::vector<Splat> splats(rows->n);
  REQUIRE(read_page(file, page, *rows, 0, splats));
  return splats;
}

SplatView part(const SplatView& all, std::uint64_t first, std::uint64_t n) {
  const auto values = static_cast<std::uint64_t>(3 * sh_coefficients(all.sh_degree));
  return {n,
          all.sh_degree,
          all.mean.subspan(3 * first, 3 * n),
          all.log_scale.subspan(3 * first, 3 * n),
          all.rotation.subspan(4 * first, 4 * n),
          all.opacity_logit.subspan(first, n),
          all.sh.subspan(values * first, values * n),
          all.mean_rest.empty() ? all.mean_rest : all.mean_rest.subspan(3 * first, 3 * n)};
}

// Every leaf has exactly one page of the cut among itself and its ancestors.
void check_replaces_leaves(const std::vector<lod::Page>& pages, const std::vector<std::uint32_t>& cut) {
  const std::set<std::uint32_t> drawn(cut.begin(), cut.end());
  REQUIRE(drawn.size() == cut.size());
  for (std::uint32_t i = 0; i < pages.size(); ++i) {
    if (pages[i].level != 0) continue;
    int found = 0;
    for (std::uint32_t p = i; p != lod::kNoPage; p = pages[p].parent) found += drawn.count(p) == 1 ? 1 : 0;
    CHECK(found == 1);
  }
}

std::uint64_t count_of(const std::vector<lod::Page>& pages, const std::vector<std::uint32_t>& cut) {
  std::uint64_t n = 0;
  for (const std::uint32_t i : cut) n += pages[i].count;
  return n;
}

}  // namespace

TEST_CASE("leaves of a file with levels equal the file without, byte for byte") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    if (scene.options.profile == Profile::archive || !scene.options.chunk_step_sets) continue;
    CAPTURE(scene.name);
    const Bytes bytes = file_of(scene);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const auto plain = leaves_as_file(*file);
    REQUIRE(plain);
    EncodeOptions direct = scene.options;
    direct.profile = Profile::direct;
    CHECK(*plain == encode(scene.leaves.view(), direct).value());
    const auto cloud = decode(bytes), again = decode(*plain);
    REQUIRE(cloud);
    REQUIRE(again);
    CHECK(cloud->mean == again->mean);
    CHECK(cloud->log_scale == again->log_scale);
    CHECK(cloud->rotation == again->rotation);
    CHECK(cloud->opacity_logit == again->opacity_logit);
    CHECK(cloud->sh == again->sh);
  }
}

TEST_CASE("leaves that share one set of steps decode to the values of the file without levels") {
  GoldenLevels scene = golden_levels("", Profile::packed, 200, 2, 40);
  scene.options.chunk_step_sets = false;
  const Bytes bytes = encode_levels(scene);
  const auto levels = decode(bytes), plain = decode(encode(scene.leaves.view(), scene.options).value());
  REQUIRE(levels);
  REQUIRE(plain);
  CHECK(levels->sh == plain->sh);
  CHECK(levels->log_scale == plain->log_scale);
}

TEST_CASE("every page holds the Gaussians that it was written from, to the format's precision") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    if (scene.options.profile == Profile::archive) continue;
    CAPTURE(scene.name);
    const Bytes bytes = file_of(scene);
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    REQUIRE(validate(*file));
    REQUIRE(file->n_pages() == scene.levels.pages.size());
    CHECK(file->n_stored() == scene.levels.splats.size());
    CHECK(file->quality_db() == scene.levels.quality_db);
    for (std::uint32_t i = 0; i < file->n_pages(); ++i) {
      CAPTURE(i);
      const lod::Page& page = file->pages()[i];
      CHECK(page.error == scene.levels.pages[i].error);
      CHECK(page.first == scene.levels.pages[i].first);
      CHECK(page.core.min == scene.levels.pages[i].core.min);
      CHECK(page.core.max == scene.levels.pages[i].core.max);
      const std::vector<Splat> splats = splats_of(*file, i);
      REQUIRE(splats.size() == page.count);
      for (std::size_t k = 0; k < splats.size(); ++k) {
        const Splat source = scene.levels.splats.view().splat(page.first + k);
        for (int j = 0; j < 3; ++j) {
          CHECK(std::abs(splats[k].mean[j] - source.mean[j]) <= page.error / 512);
          CHECK(std::abs(splats[k].log_scale[j] - source.log_scale[j]) <= 0x1p-10);
        }
        // Golden values are at most 2, so a step is at most 2 / 127.
        for (int j = 0; j < 3 * sh_coefficients(scene.leaves.sh_degree); ++j) {
          CHECK(std::abs(splats[k].sh[j] - source.sh[j]) <= 1.0001f / 127);
        }
      }
    }
  }
}

TEST_CASE("pages of an archive keep its stated bounds on all levels") {
  const GoldenLevels scene = golden_levels("", Profile::archive, 700, 3, 41, 3);
  const Bytes bytes = encode_levels(scene);
  CHECK(scene.levels.pages[0].level == 2);
  check_pages_within_bounds(bytes, scene);
  // Positions refer to the leaves: a page's are in it.
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  std::uint64_t leaf = 0, in_order = 0;
  for (std::uint32_t page = 0; page < file->n_pages(); ++page) {
    if (file->pages()[page].level != 0) continue;
    std::set<std::uint64_t> positions;
    const std::uint64_t first = leaf;
    for (std::uint32_t i = 0; i < file->pages()[page].count; ++i, ++leaf) {
      positions.insert(file->source_index(leaf));
      in_order += file->source_index(leaf) == leaf;
    }
    CHECK(*positions.begin() == first);
    CHECK(*positions.rbegin() == leaf - 1);
    CHECK(positions.size() == leaf - first);
  }
  CHECK(leaf == 700);
  CHECK(in_order < 100);  // archives have an order of their own
}

TEST_CASE("an archive stores pages more coarsely the higher they are") {
  // The same Gaussians on every level: what shows a quarter as large needs less.
  GoldenLevels scene = golden_levels("", Profile::archive, 256, 2, 46, 8);
  lod::Levels& levels = scene.levels;
  REQUIRE(levels.pages.size() == 1);
  constexpr std::uint32_t kLevels = 3;  // above, cells of means are fine enough without parts
  const SplatCloud leaves = scene.leaves;
  const lod::Page leaf = levels.pages[0];
  levels.pages.clear();
  levels.splats.resize(kLevels * leaves.size(), leaves.sh_degree);
  for (std::uint32_t i = 0; i < kLevels; ++i) {
    lod::Page& page = levels.pages.emplace_back(leaf);
    page.first = i * leaves.size();
    page.level = kLevels - 1 - i;
    page.error = 0.01f * static_cast<float>(page.level);
    page.parent = i == 0 ? lod::kNoPage : i - 1;
    page.first_child = page.level == 0 ? 0 : i + 1;
    page.n_children = page.level == 0 ? 0 : 1;
    for (std::uint64_t k = 0; k < leaves.size(); ++k) levels.splats.set(page.first + k, leaves.view().splat(k));
  }
  const Bytes bytes = encode_levels(scene);
  check_pages_within_bounds(bytes, scene);
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  for (std::uint32_t i = 0; i + 1 < kLevels; ++i) {
    CAPTURE(i);
    CHECK(file->stored(i).stored_bytes < 0.95 * file->stored(i + 1).stored_bytes);
  }
  // A pixel blurs twice as much, in which steps are: means move twice as far where Gaussians are smaller than that.
  std::vector<double> distance(kLevels);  // squared, to the nearest mean of the source
  for (std::uint32_t i = 0; i < kLevels; ++i) {
    for (const Splat& s : splats_of(*file, i)) {
      double nearest = std::numeric_limits<double>::infinity();
      for (std::uint64_t k = 0; k < leaves.size(); ++k) {
        double squared = 0;
        for (std::size_t j = 0; j < 3; ++j) squared += std::pow(s.mean[j] - leaves.mean[3 * k + j], 2.0);
        nearest = std::min(nearest, squared);
      }
      distance[i] += nearest / static_cast<double>(leaves.size());
    }
  }
  for (std::uint32_t i = 0; i + 1 < kLevels; ++i) {
    CAPTURE(i);
    CHECK(distance[i] > 2 * distance[i + 1]);
  }
}

TEST_CASE("pages of an archive have at most 2^15 Gaussians") {
  const SplatCloud cloud = golden_cloud(40'000, 0, 47);
  for (const std::uint32_t page_chunks : {512u, 513u}) {
    const lod::Levels levels = trivial_levels(cloud, {.chunk_size = 64, .page_chunks = page_chunks});
    for (const Profile profile : {Profile::direct, Profile::archive}) {
      EncodeOptions options;
      options.profile = profile;
      options.chunk_size = 64;
      options.order = profile == Profile::archive ? Order::morton : Order::input;
      Bytes bytes;
      const auto written = write_levels(levels, options, bytes);
      if (profile == Profile::archive && page_chunks == 513) {
        REQUIRE_FALSE(written);
        CHECK(written.error().code == Errc::bad_argument);
      } else {
        REQUIRE(written);
        CHECK(PagedFile::open(bytes)->pages()[1].count == 64 * page_chunks);
      }
    }
  }
}

TEST_CASE("the bytes do not depend on the number of threads") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    GoldenLevels scene = golden_levels("", profile, 3000, 2, 42);
    Bytes one, two;
    scene.options.archive.threads = 1;
    REQUIRE(write_levels(scene.levels, scene.options, one, 1));
    scene.options.archive.threads = 2;
    REQUIRE(write_levels(scene.levels, scene.options, two, 2));
    CHECK(one == two);
  }
}

TEST_CASE("pages encoded elsewhere, in any order, make the same file, and damaged ones make none") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    CAPTURE(scene.name);
    const auto scan_of = [&scene](int sh_degree) {
      SceneScan of(sh_degree, BadPolicy::refuse);
      for (std::uint64_t i = 0; i < scene.leaves.size(); ++i) {
        Splat s = scene.leaves.view().splat(i);
        of.add(s);
      }
      return of;
    };
    const SceneScan scan = scan_of(scene.leaves.sh_degree);
    auto encoder = PageEncoder::create(scan, scene.options);
    REQUIRE(encoder);
    const std::vector<lod::Page>& pages = scene.levels.pages;
    std::vector<Bytes> records(pages.size());
    for (std::size_t i = pages.size(); i-- > 0;) {
      const auto record = encoder->encode(pages[i], part(scene.levels.splats.view(), pages[i].first, pages[i].count));
      REQUIRE(record);
      records[i].assign(record->begin(), record->end());
    }
    Bytes bytes;
    auto writer = LevelsWriter::create(bytes, scan, scene.options, pages, scene.levels.quality_db);
    REQUIRE(writer);
    for (const Bytes& record : records) REQUIRE(writer->add(record));
    CHECK(writer->add(records[0]).error().code == Errc::bad_argument);  // no page is left
    CHECK_FALSE(writer->finish());

    bytes.clear();
    auto again = LevelsWriter::create(bytes, scan, scene.options, pages, scene.levels.quality_db);
    REQUIRE(again);
    for (const Bytes& record : records) REQUIRE(again->add(record));
    REQUIRE(again->finish());
    CHECK(bytes == encode_levels(scene));

    // Every byte of a record is checked, and every prefix.
    const auto added = [&](const Bytes& record) {
      Bytes nothing;
      auto other = LevelsWriter::create(nothing, scan, scene.options, pages, scene.levels.quality_db);
      REQUIRE(other);
      return other->add(record);
    };
    for (std::size_t i = 0; i < records[0].size(); i += i < 200 ? 1 : 97) {
      Bytes damaged = records[0];
      damaged[i] ^= std::byte{1};
      REQUIRE(added(damaged).error().code == Errc::checksum_mismatch);
    }
    for (std::size_t n = 0; n < 200 && n < records[0].size(); ++n) {
      const Errc code =
          added(Bytes(records[0].begin(), records[0].begin() + static_cast<std::ptrdiff_t>(n))).error().code;
      REQUIRE((code == Errc::truncated || code == Errc::checksum_mismatch));
    }
    if (pages.size() > 1) CHECK(added(records.back()).error().code == Errc::bad_argument);  // the wrong page
    if (scene.options.profile == Profile::archive && scan.sh_degree() > 0) {
      auto shorter = PageEncoder::create(scan_of(0), scene.options);
      REQUIRE(shorter);
      const auto record = shorter->encode(pages[0], part(scene.levels.splats.view(), pages[0].first, pages[0].count));
      REQUIRE(record);
      CHECK(added(Bytes(record->begin(), record->end())).error().code == Errc::bad_argument);
    }
  }
}

TEST_CASE("every valid scene can be written with levels, and the file is valid") {
  for (std::uint64_t seed = 0; seed < 60; ++seed) {
    CAPTURE(seed);
    SplitMix random(seed);
    const SplatCloud cloud = random_cloud(1 + random.below(500), static_cast<int>(random.below(4)), random);
    const lod::Levels levels = trivial_levels(cloud, {.chunk_size = 32, .page_chunks = 2});
    for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
      EncodeOptions options;
      options.profile = profile;
      options.chunk_size = 32;
      options.order = profile == Profile::archive ? Order::morton : Order::input;
      options.chunk_step_sets = profile == Profile::archive || seed % 2 == 0;
      Bytes bytes;
      const auto written = write_levels(levels, options, bytes);
      if (!written) {  // values without archive codes
        CHECK(profile == Profile::archive);
        CHECK(written.error().code == Errc::bad_value);
        continue;
      }
      const auto file = PagedFile::open(bytes);
      REQUIRE(file);
      const Status valid = validate(*file);
      CHECK_MESSAGE(valid, (valid ? "" : valid.error().what));
    }
  }
}

TEST_CASE("pages cost little more than a file of the same Gaussians") {
  // Noise does not compress, so paging loses no compression: the rest is the cost of pages.
  const SplatCloud cloud = golden_cloud(40000, 3, 5);
  const lod::Levels tree = trivial_levels(cloud, {.page_chunks = 12});
  const double share = static_cast<double>(tree.splats.size()) / static_cast<double>(cloud.size());
  for (const Profile profile : {Profile::packed, Profile::archive}) {
    EncodeOptions options;
    options.profile = profile;
    options.order = profile == Profile::archive ? Order::morton : Order::input;
    const auto plain = encode(cloud.view(), options);
    REQUIRE(plain);
    Bytes levels;
    REQUIRE(write_levels(tree, options, levels));
    const double ratio = static_cast<double>(levels.size()) / static_cast<double>(plain->size()) / share;
    CAPTURE(ratio);
    CHECK(ratio < 1.02);
  }
}

TEST_CASE("every prefix that holds the root is a scene and says what is missing") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    CAPTURE(scene.name);
    const Bytes whole = file_of(scene);
    const std::uint64_t first_page = section_of(whole, "PAGE");
    const auto complete = PagedFile::open(whole);
    REQUIRE(complete);
    CHECK(complete->complete());
    CHECK(complete->finest_present() == 0);
    std::uint32_t before = 0;
    for (std::uint64_t size = 0; size < whole.size(); size += size < first_page + 64 ? 1 : 37) {
      const Bytes bytes(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(size));  // of exact size
      CAPTURE(size);
      const auto file = PagedFile::open(bytes);
      REQUIRE_FALSE(FileView::open(bytes));
      if (!file) {
        CHECK(file.error().code == Errc::truncated);
        CHECK(file.error().offset == size);
        CHECK(size < first_page);
        continue;
      }
      CHECK_FALSE(file->complete());
      REQUIRE(validate(*file));
      const std::uint32_t n = file->n_present();
      CHECK(n >= before);
      before = n;
      for (std::uint32_t i = 0; i < n; ++i) {
        CHECK(file->stored(i).offset + file->stored(i).stored_bytes <= size);
      }
      if (n < file->n_pages()) CHECK(file->stored(n).offset + file->stored(n).stored_bytes > size);
      const std::uint32_t finest = file->finest_present();
      CHECK((finest < file->n_levels()) == (n != 0));
      if (finest < file->n_levels()) CHECK(read_pages(*file, lod::pages_of_level(file->pages(), finest)));
      if (finest > 0) {
        const auto missing = read_pages(*file, lod::pages_of_level(file->pages(), finest - 1));
        REQUIRE_FALSE(missing);
        CHECK(missing.error().code == Errc::pages_missing);
        CHECK(missing.error().offset == size);
      }
      const auto leaves = leaves_as_file(*file);
      if (n == file->n_pages()) {
        // Sections behind the pages count as absent.
        REQUIRE(leaves);
        CHECK(FileView::open(*leaves)->find(SectionType::permutation) == nullptr);
        CHECK(decode(*leaves)->size() == scene.leaves.size());
      } else {
        REQUIRE_FALSE(leaves);
        CHECK(leaves.error().code == Errc::pages_missing);
      }
      CHECK(decode(bytes).error().code == Errc::pages_missing);
    }
    CHECK(before == complete->n_pages());
  }
}

TEST_CASE("every single-byte change of a file with levels is an error or a valid decode") {
  for (const Profile profile : {Profile::direct, Profile::packed, Profile::archive}) {
    const GoldenLevels scene = golden_levels("", profile, 70, 0, 43, 1);
    const Bytes sound = encode_levels(scene);
    const std::uint64_t pages = section_of(sound, "PAGE");
    const std::uint64_t pages_end = pages + get<std::uint64_t>(sound, entry_of(sound, "PAGE") + 24);
    std::size_t n_errors = 0, n_valid = 0;
    for (std::size_t i = 0; i < sound.size(); ++i) {
      for (const unsigned flip : {1u, 0x80u}) {
        // A page's bytes change in the highest and lowest bit in turn; all others change in both.
        if (i >= pages && i < pages_end && (i % 2 == 0) == (flip == 1)) continue;
        Bytes bytes = sound;
        bytes[i] ^= static_cast<std::byte>(flip);
        const auto as_it_is = decode(bytes);
        CHECK_FALSE(as_it_is);
        fix_hashes(bytes);
        if (const auto fixed = decode(bytes)) {
          ++n_valid;
          CHECK(fixed->view().consistent());
        } else {
          ++n_errors;
          CHECK(fixed.error().offset <= bytes.size());
        }
      }
    }
    CHECK(n_errors > 200);
    CHECK(n_valid > 100);
  }
}

TEST_CASE("a page decodes from its bytes, wherever they come from, and from no others") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 44);
  const Bytes bytes = encode_levels(scene);
  // A client that has fetched the head only.
  const Bytes head(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(section_of(bytes, "PAGE")));
  const auto file = PagedFile::open(head);
  REQUIRE(file);
  CHECK(file->n_present() == 0);
  PageDecoder decoder(*file);
  Bytes memory(file->largest_decoded_bytes());
  const auto stored = [&](std::uint32_t page) {
    return std::span<const std::byte>(bytes).subspan(file->stored(page).offset, file->stored(page).stored_bytes);
  };
  for (std::uint32_t i = 0; i < file->n_pages(); ++i) {
    const auto out = std::span(memory).first(file->decoded_bytes(i));
    const auto rows = decoder.decode(i, stored(i), out);
    REQUIRE(rows);
    CHECK(check_page_values(*file, i, *rows));
  }
  const auto out = std::span(memory).first(file->decoded_bytes(1));
  CHECK(decoder.decode(1, stored(2), out).error().offset == file->stored(1).offset);
  CHECK(decoder.decode(1, stored(1).first(stored(1).size() - 1), out).error().code == Errc::size_mismatch);
  Bytes damaged(stored(1).begin(), stored(1).end());
  damaged[damaged.size() / 2] ^= std::byte{1};
  const auto refused = decoder.decode(1, damaged, out);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::checksum_mismatch);
  CHECK(refused.error().offset == file->stored(1).offset);
}

TEST_CASE("boxes of pages hold everything stored below, whatever the tree says") {
  for (const Profile profile : {Profile::direct, Profile::archive}) {
    GoldenLevels scene = golden_levels("", profile, 300, 1, 45);
    const Bytes bytes = file_of(scene);  // with boxes of means only
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    REQUIRE(validate(*file));
    for (std::uint32_t i = 0; i < file->n_pages(); ++i) {
      const lod::Page& page = file->pages()[i];
      for (const Splat& s : splats_of(*file, i)) {
        for (std::uint32_t p = i; p != lod::kNoPage; p = file->pages()[p].parent) {
          for (std::size_t k = 0; k < 3; ++k) {
            CHECK(s.mean[k] > file->pages()[p].bounds.min[k]);
            CHECK(s.mean[k] < file->pages()[p].bounds.max[k]);
          }
        }
      }
      for (std::size_t k = 0; k < 3; ++k) {
        CHECK(page.bounds.max[k] - page.bounds.min[k] >
              scene.levels.pages[i].bounds.max[k] - scene.levels.pages[i].bounds.min[k]);
      }
    }
  }
}

TEST_CASE("cuts replace every leaf once, and the finest affordable one is chosen") {
  const SplatCloud cloud = golden_cloud(5000, 0, 6);
  lod::Levels levels = trivial_levels(cloud, {.chunk_size = 32, .page_chunks = 2});
  // Errors differ from page to page, so that cuts run through the levels.
  SplitMix random(7);
  for (std::size_t i = levels.pages.size(); i-- > 1;) {
    lod::Page& parent = levels.pages[levels.pages[i].parent];
    parent.error = std::max(parent.error, levels.pages[i].error + random.dyadic(1, 3));
  }
  REQUIRE(lod::check_pages(levels.pages, 32));
  for (std::uint32_t level = 0; level < levels.pages[0].level + 1; ++level) {
    check_replaces_leaves(levels.pages, lod::pages_of_level(levels.pages, level));
  }
  const std::uint64_t root = levels.pages[0].count;
  for (const std::uint64_t max : {root, root + 1, std::uint64_t{200}, std::uint64_t{500}, std::uint64_t{1300},
                                  std::uint64_t{4999}, std::uint64_t{5000}, std::uint64_t{1} << 40}) {
    CAPTURE(max);
    const std::vector<std::uint32_t> cut = lod::finest_cut(levels.pages, max);
    check_replaces_leaves(levels.pages, cut);
    CHECK(count_of(levels.pages, cut) <= max);
    // No lower error threshold gives a cut that fits.
    float largest = 0;
    for (const std::uint32_t i : cut) largest = std::max(largest, levels.pages[i].error);
    for (const lod::Page& p : levels.pages) {
      if (p.error >= largest) continue;
      std::vector<std::uint32_t> finer;
      for (std::uint32_t i = 0; i < levels.pages.size(); ++i) {
        const lod::Page& page = levels.pages[i];
        const bool shown = page.parent == lod::kNoPage || levels.pages[page.parent].error > p.error;
        if (page.error <= p.error && shown) finer.push_back(i);
      }
      CHECK(count_of(levels.pages, finer) > max);
    }
    // In leaf order.
    std::uint64_t leaf = 0;
    for (const std::uint32_t i : cut) {
      std::uint32_t first = i;
      while (levels.pages[first].n_children != 0) first = levels.pages[first].first_child;
      CHECK(levels.pages[first].first >= leaf);
      leaf = levels.pages[first].first;
    }
  }
  CHECK(lod::finest_cut(levels.pages, root - 1).empty());
  CHECK(lod::finest_cut(levels.pages, ~std::uint64_t{0}, 1) == std::vector<std::uint32_t>{0});
  const auto first_two = lod::finest_cut(levels.pages, ~std::uint64_t{0}, levels.pages[0].n_children + 1);
  CHECK(first_two.size() == levels.pages[0].n_children);
}

TEST_CASE("a limit of Gaussians takes the finest step of the detail whose cut fits, never finer than asked for") {
  const lod::Levels levels = trivial_levels(golden_cloud(5000, 0, 8), {.chunk_size = 32, .page_chunks = 2});
  const auto n_pages = static_cast<std::uint32_t>(levels.pages.size());
  const std::uint32_t root = levels.pages.front().count;
  SplitMix random(10);
  std::set<float> details;
  for (int i = 0; i < 200; ++i) {
    lod::Eye eye;
    for (double& x : eye.position) x = static_cast<double>(random.dyadic(-8, 8));
    eye.focal_px = 100;
    eye.z_near = 0.01;
    const float asked = i % 4 == 0 ? 0 : 0.2F * static_cast<float>(i % 9);
    const std::uint32_t n_present = i % 5 == 0 ? n_pages / 3 : i % 5 == 1 ? n_pages - 1 : n_pages;
    const auto count = [&](float detail) {
      std::uint64_t n = 0;
      for (const std::uint32_t page : lod::drawn_pages(levels.pages, eye, detail, n_present))
        n += levels.pages[page].count;
      return n;
    };
    std::vector<std::uint64_t> limits{0, root, 300, 1500, count(asked) - 1, count(asked), ~std::uint64_t{0}};
    std::ranges::sort(limits);
    float before = std::numeric_limits<float>::infinity();
    for (const std::uint64_t most : limits) {
      float expected = asked;
      while (count(expected) > std::max<std::uint64_t>(most, root)) expected = lod::coarser(expected);
      const lod::DetailChoice choice = lod::finest_detail(levels.pages, eye, asked, most, n_present);
      CHECK(choice.detail_px == expected);
      CHECK(choice.gaussians == count(expected));
      CHECK(choice.detail_px <= before);
      before = choice.detail_px;
      details.insert(before);
    }
    CHECK(before == asked);
  }
  CHECK(details.size() > 20);
}

TEST_CASE("steps of the detail start at what was asked for, and at a quarter of a pixel after the leaves") {
  const lod::DetailSteps steps = lod::detail_steps(0);
  CHECK(steps.px[0] == 0);
  CHECK(steps.px[1] == 0.25F);
  CHECK(steps.px[2] == 0.3F);
  CHECK(lod::detail_steps(2).px[1] == 2.4F);
  CHECK(steps.px[lod::kDetailSteps - 1] == std::numeric_limits<float>::max());
  CHECK(lod::is_fine_enough(1e30F, steps.px[lod::kDetailSteps - 1], 1e-5));  // so the root is drawn in the end
  CHECK(lod::coarser(3e38F) == std::numeric_limits<float>::max());
  CHECK(lod::first_fine_step(steps, 0, 1) == 0);
  CHECK(lod::first_fine_step(steps, 0.26F, 1) == 2);
  CHECK(lod::first_fine_step(steps, 1, 1e-30) == lod::kDetailSteps - 1);
}

TEST_CASE("a view's cut is measured to the cores and replaces every leaf once from every camera") {
  lod::Levels levels = trivial_levels(golden_cloud(5000, 0, 8), {.chunk_size = 32, .page_chunks = 2});
  SplitMix random(9);
  // Boxes that a single Gaussian makes larger than the scene do not locate pages.
  for (lod::Page& page : levels.pages) {
    for (std::size_t k = 0; k < 3; ++k) page.bounds.min[k] -= 1000, page.bounds.max[k] += 1000;
  }
  REQUIRE(lod::check_pages(levels.pages, 32));
  std::set<std::size_t> sizes;
  for (int i = 0; i < 300; ++i) {
    lod::Eye eye;
    for (double& x : eye.position) x = static_cast<double>(random.dyadic(-8, 8));
    eye.z_near = 0.01;
    const float detail = 0.05f * static_cast<float>(1 + i % 20);
    const std::vector<std::uint32_t> drawn = lod::drawn_pages(levels.pages, eye, detail);
    check_replaces_leaves(levels.pages, drawn);
    sizes.insert(drawn.size());
    const auto fine = [&](std::uint32_t page) {
      return static_cast<double>(levels.pages[page].error) <=
             static_cast<double>(detail) * lod::footprint(levels.pages[page].core, eye);
    };
    for (std::uint32_t p = 0; p < levels.pages.size(); ++p) {
      const std::uint32_t parent = levels.pages[p].parent;
      CHECK(std::ranges::count(drawn, p) == (fine(p) && (parent == lod::kNoPage || !fine(parent)) ? 1 : 0));
    }
  }
  CHECK(sizes.size() > 5);
}

TEST_CASE("the writer refuses an invalid tree and pages out of order") {
  const GoldenLevels scene = golden_levels("", Profile::direct, 300, 1, 46);
  const auto refused = [&](auto change, const EncodeOptions& options) {
    lod::Levels levels = scene.levels;
    change(levels);
    Bytes bytes;
    const auto written = write_levels(levels, options, bytes);
    return written ? Errc::internal : written.error().code;
  };
  const auto nothing = [](lod::Levels&) {};
  const EncodeOptions& options = scene.options;
  CHECK(refused([](lod::Levels& l) { l.pages[1].error = l.pages[0].error; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages[3].error = 1e-9f; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages[2].parent = 1; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages[1].bounds.max[0] = 1e9f; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages[1].core.max[0] = l.pages[0].core.max[0] + 1; }, options) ==
        Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages.pop_back(); }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.pages[3].count -= 1, l.pages[4].count += 1; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.quality_db = -1; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l = {}; }, options) == Errc::bad_argument);
  CHECK(refused([](lod::Levels& l) { l.splats.mean[1] = std::numeric_limits<float>::quiet_NaN(); }, options) ==
        Errc::bad_value);
  EncodeOptions archive = options;
  archive.profile = Profile::archive;
  archive.order = Order::morton;
  archive.chunk_step_sets = false;
  CHECK(refused(nothing, archive) == Errc::bad_argument);

  SceneScan scan(1);
  for (std::uint64_t i = 0; i < scene.leaves.size(); ++i) {
    Splat s = scene.leaves.view().splat(i);
    scan.add(s);
  }
  CHECK(PageEncoder::create(scan, archive).error().code == Errc::bad_argument);
  Bytes bytes;
  const SplatView all = scene.levels.splats.view();
  const auto page_of = [&](std::uint32_t i) {
    return part(all, scene.levels.pages[i].first, scene.levels.pages[i].count);
  };
  {
    auto writer = LevelsWriter::create(bytes, scan, options, scene.levels.pages);
    REQUIRE(writer);
    LevelsWriter::Encoder encoder(*writer);
    CHECK(encoder.encode(1, page_of(0)).error().code == Errc::bad_argument);
    REQUIRE(encoder.encode(1, page_of(1)));
    CHECK(writer->add(encoder).error().code == Errc::bad_argument);  // page 0 is next
    REQUIRE(encoder.encode(0, page_of(0)));
    CHECK(writer->add(encoder).error().code == Errc::bad_argument);  // nothing follows an error
    CHECK(writer->finish().error().code == Errc::bad_argument);
  }
  {
    auto writer = LevelsWriter::create(bytes, scan, options, scene.levels.pages);
    REQUIRE(writer);
    LevelsWriter::Encoder encoder(*writer);
    for (std::uint32_t i = 0; i + 1 < scene.levels.pages.size(); ++i) {
      REQUIRE(encoder.encode(i, page_of(i)));
      REQUIRE(writer->add(encoder));
    }
    CHECK(writer->finish().error().code == Errc::bad_argument);  // one page is missing
  }
  {
    auto writer = LevelsWriter::create(bytes, scan, options, scene.levels.pages);
    REQUIRE(writer);
    LevelsWriter::Encoder encoder(*writer);
    SplatCloud moved = scene.levels.splats;
    for (float& x : moved.mean) x += 1;
    for (std::uint32_t i = 0; i < scene.levels.pages.size(); ++i) {
      REQUIRE(encoder.encode(i, part(moved.view(), scene.levels.pages[i].first, scene.levels.pages[i].count)));
      REQUIRE(writer->add(encoder));
    }
    CHECK(writer->finish().error().code == Errc::read_failed);  // not the scanned leaves
  }
}

TEST_CASE("limits count the Gaussians of all levels and the decoded bytes of pages") {
  const GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 47);
  const Bytes bytes = encode_levels(scene);
  DecodeLimits limits;
  limits.max_gaussians = scene.levels.splats.size();
  CHECK(PagedFile::open(bytes, limits));
  --limits.max_gaussians;
  CHECK(PagedFile::open(bytes, limits).error().code == Errc::limit_exceeded);
  limits = {};
  limits.max_decoded_bytes = 10'000;
  const auto refused = PagedFile::open(bytes, limits);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
  CHECK(refused.error().offset == entry_of(bytes, "PAGE") + 32);
}

TEST_CASE("readers of one kind of file name the other") {
  const GoldenLevels scene = golden_levels("", Profile::direct, 100, 1, 48);
  const Bytes levels = encode_levels(scene), plain = encode(scene.leaves.view(), scene.options).value();
  CHECK(has_levels(levels));
  CHECK_FALSE(has_levels(plain));
  CHECK_FALSE(has_levels({}));
  CHECK_FALSE(has_levels(std::span(levels).first(130)));
  const auto view = FileView::open(levels);
  REQUIRE_FALSE(view);
  CHECK(view.error().code == Errc::unsupported_feature);
  CHECK(view.error().offset == entry_of(levels, "LODS"));
  const auto file = PagedFile::open(plain);
  REQUIRE_FALSE(file);
  CHECK(file.error().code == Errc::missing_section);
}

TEST_CASE("limits count a prefix's present bytes, not those that its head declares") {
  SplatCloud equal;
  equal.resize(30'000, 3);
  SplitMix random(61);
  const Splat one = random_cloud(1, 3, random).view().splat(0);
  for (std::uint64_t i = 0; i < equal.size(); ++i) equal.set(i, one);
  EncodeOptions options;
  options.profile = Profile::packed;
  options.keep_permutation = true;
  Bytes bytes;
  REQUIRE(write_levels(trivial_levels(equal), options, bytes));
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  DecodeLimits limits;
  limits.max_expansion =
      (file->head().find(SectionType::pages)->decoded_bytes - (std::uint64_t{1} << 20)) / bytes.size() + 1;
  CHECK(PagedFile::open(bytes, limits));
  bytes.resize(file->stored(file->n_pages() - 1).offset + file->stored(file->n_pages() - 1).stored_bytes);
  bytes.shrink_to_fit();
  CHECK(PagedFile::open(bytes));
  const auto refused = PagedFile::open(bytes, limits);
  REQUIRE_FALSE(refused);
  CHECK(refused.error().code == Errc::limit_exceeded);
  CHECK(refused.error().offset == entry_of(bytes, "PAGE") + 32);
}

TEST_CASE("every reader of the leaves checks the hashes of their sections") {
  GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 62);
  scene.options.keep_permutation = true;
  scene.options.source_index = {};
  const Bytes sound = encode_levels(scene);
  for (const char* type : {"PERM", "PAGE"}) {
    CAPTURE(type);
    Bytes bytes = sound;
    const std::uint64_t hash_at = entry_of(bytes, type) + 40;
    put(bytes, hash_at, get<std::uint64_t>(bytes, hash_at) ^ 1);
    const std::uint64_t table_end = entry_at(get<std::uint32_t>(bytes, 52));
    put(bytes, table_end, xxh3(std::span<const std::byte>(bytes).first(table_end)));
    const auto file = PagedFile::open(bytes);
    REQUIRE(file);
    const Status status = validate(*file);
    REQUIRE_FALSE(status);
    CHECK(status.error().code == Errc::checksum_mismatch);
    CHECK(status.error().offset == section_of(bytes, type));
    if (type == std::string_view("PAGE")) continue;  // each page was checked against its own
    const auto leaves = leaves_as_file(*file);
    REQUIRE_FALSE(leaves);
    CHECK(leaves.error().code == Errc::checksum_mismatch);
    CHECK(leaves.error().offset == section_of(bytes, type));
  }
}

TEST_CASE("pages with origins keep positions that FP32 rounds, and everything else") {
  for (const Profile profile : {Profile::direct, Profile::packed}) {
    for (const double moved : {300000., -7e6, 5000.}) {
      CAPTURE(moved);
      GoldenLevels scene = golden_origins("", profile, 500, 39, moved);
      const Bytes bytes = encode_levels(scene);
      const auto file = PagedFile::open(bytes);
      REQUIRE(file);
      REQUIRE(validate(*file));
      CHECK(file->head().header().version_minor == 5);
      std::uint64_t n_origins = 0;
      for (std::uint32_t i = 0; i < file->n_pages(); ++i) {
        n_origins += file->stored(i).n_origins;
        CHECK((file->stored(i).n_origins == 0) == (file->pages()[i].level != 0));
      }
      CHECK(n_origins > file->pages().size());  // far and near ones share a page
      const auto cloud = read_pages(*file, lod::pages_of_level(file->pages(), 0));
      REQUIRE(cloud);
      CHECK(cloud->mean == scene.leaves.mean);
      double worst = 0;
      for (std::size_t i = 0; i < cloud->mean.size(); ++i) {
        const double rest = static_cast<double>(cloud->mean_rest[i]);
        worst = std::max(worst, std::fabs(rest - static_cast<double>(scene.leaves.mean_rest[i])));
      }
      CHECK(worst <= 0.00025);
      // All that does not know of origins reads the file that rounds.
      scene.options.page_origins = false;
      const Bytes rounded = encode_levels(scene);
      const auto without = PagedFile::open(rounded);
      REQUIRE(without);
      CHECK(without->head().header().version_minor == 4);
      const auto plain = leaves_as_file(*file), same = leaves_as_file(*without);
      REQUIRE(plain);
      CHECK(*plain == *same);
    }
  }
}

TEST_CASE("a scene without rests has no origins, whatever is asked") {
  GoldenLevels scene = golden_levels("", Profile::packed, 300, 1, 33);
  const Bytes without = encode_levels(scene);
  scene.options.page_origins = true;
  CHECK(encode_levels(scene) == without);
}

TEST_CASE("records of pages carry origins") {
  const GoldenLevels scene = golden_origins("", Profile::packed, 200, 40);
  const Bytes expected = encode_levels(scene);
  SceneScan scan(0, BadPolicy::refuse);
  for (std::uint64_t i = 0; i < scene.leaves.size(); ++i) {
    Splat s = scene.leaves.view().splat(i);
    scan.add(s);
  }
  auto encoder = PageEncoder::create(scan, scene.options);
  REQUIRE(encoder);
  Bytes bytes;
  auto writer = LevelsWriter::create(bytes, scan, scene.options, scene.levels.pages, scene.levels.quality_db);
  REQUIRE(writer);
  for (const lod::Page& page : writer->pages()) {
    const auto record = encoder->encode(page, part(scene.levels.splats.view(), page.first, page.count));
    REQUIRE(record);
    REQUIRE(writer->add(*record));
  }
  REQUIRE(writer->finish());
  CHECK(bytes == expected);
}
