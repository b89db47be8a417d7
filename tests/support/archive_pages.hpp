// archive_pages.hpp - checks that the pages of an archive with levels hold what they were written from.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include "archive_bounds.hpp"
#include "golden_levels.hpp"
#include "rgs/paged_file.hpp"

namespace rgs::test {

/// Every Gaussian of every page, against the bounds that the file states.
inline void check_pages_within_bounds(std::span<const std::byte> bytes, const GoldenLevels& scene) {
  const auto file = PagedFile::open(bytes);
  REQUIRE(file);
  REQUIRE(validate(*file));
  CHECK(file->head().header().version_minor == 5);
  REQUIRE(file->pages().size() == scene.levels.pages.size());
  const StatedBounds bounds(bytes);
  PageDecoder decoder(*file);
  Bytes memory;
  std::uint64_t leaf = 0;
  for (std::uint32_t page = 0; page < file->n_pages(); ++page) {
    CAPTURE(page);
    memory.assign(file->decoded_bytes(page), std::byte{0xA5});
    const auto rows = decoder.decode(page, file->bytes(page), memory);
    REQUIRE(rows);
    std::vector<ActivatedSplat> splats(rows->n);
    REQUIRE(read_page(*file, page, *rows, 0, splats));
    const lod::Page& expected = scene.levels.pages[page];
    REQUIRE(rows->n == expected.count);
    const auto level = static_cast<int>(expected.level);
    const auto same = [&](const Splat& source, std::uint32_t i) {
      const std::uint64_t set = 48 * (i / scene.options.chunk_size);
      const auto step = [&](int k) {
        return get<float>(rows->steps, set + static_cast<std::uint64_t>(12 * sh_degree_of(k / 3) + 4 * (k % 3)));
      };
      return is_within(bounds, level, scene.leaves.sh_degree, source, splats[i], step);
    };
    for (std::uint32_t i = 0; i < rows->n; ++i) {
      CAPTURE(i);
      if (level == 0) {
        CHECK(same(scene.leaves.view().splat(file->source_index(leaf++)), i));
        continue;
      }
      bool found = false;  // only leaves have positions in the source: above, any of the page
      for (std::uint64_t k = 0; k < expected.count && !found; ++k) {
        found = same(scene.levels.splats.view().splat(expected.first + k), i);
      }
      CHECK(found);
    }
  }
  CHECK(leaf == scene.leaves.size());
}

}  // namespace rgs::test
