// check_error_test.cpp - errors measured on finished pages: near the builder's, whatever is stated.
// SPDX-License-Identifier: Apache-2.0
#include "check_error.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <cstdint>
#include <vector>

#include "build_levels.hpp"
#include "lod_scenes.hpp"

namespace {

using namespace rgs::lod;
using rgs::SplatCloud;

SplatCloud rows(const SplatCloud& all, std::uint64_t first, std::uint64_t n) {
  SplatCloud out;
  out.resize(n, all.sh_degree);
  for (std::uint64_t i = 0; i < n; ++i) out.set(i, all.view().splat(first + i));
  return out;
}

SplatCloud page_of(const Levels& levels, const Page& page) {
  return rows(levels.splats, page.first, page.count);
}

SplatCloud children_of(const Levels& levels, const Page& page) {
  const Page &first = levels.pages[page.first_child], &last = levels.pages[page.first_child + page.n_children - 1];
  return rows(levels.splats, first.first, last.first + last.count - first.first);
}

SplatCloud small_wall(std::uint64_t side) {
  rgs::test::SplitMix random(7);
  return rgs::test::wall(side, 1, random);
}

}  // namespace

TEST_CASE("a page's error against its children is near the one that its builder states, or below") {
  for (const Quality quality : {Quality::fast, Quality::best}) {
    const Levels levels = build_levels(small_wall(64).view(), {.quality = quality, .chunk_size = 32, .page_chunks = 6});
    std::uint32_t n_inner = 0;
    for (const Page& page : levels.pages) {
      if (page.n_children == 0) continue;
      ++n_inner;
      const SplatCloud children = children_of(levels, page), own = page_of(levels, page);
      CAPTURE(page.level);
      CAPTURE(page.error);
      const float measured = error_against(children.view(), own.view(), page.error);
      CHECK(measured > 0);
      CHECK(measured < 3 * page.error);
      // Too small or too large an error changes little.
      const float lie = error_against(children.view(), own.view(), 1e-6F * page.error);
      CHECK(lie > 0.2F * page.error);
      CHECK(lie < 3 * page.error);
      CHECK(error_against(children.view(), own.view(), 1e30F) <= 1e30F);
    }
    CHECK(n_inner > 5);
  }
}

TEST_CASE("a page that does not look like its children has several times the stated error") {
  const Levels levels = build_levels(small_wall(80).view());
  for (const Page& page : levels.pages) {
    if (page.level != 1) continue;
    const SplatCloud children = children_of(levels, page);
    SplatCloud own = page_of(levels, page);
    SUBCASE("colour") {
      for (std::uint64_t i = 0; i < own.size(); ++i) own.sh[i * own.sh.size() / own.size()] += 1.5F;
    }
    SUBCASE("opacity") {
      for (float& logit : own.opacity_logit) logit = -3;
    }
    SUBCASE("place") {
      const float reach = 20 * page.error;
      for (std::size_t i = 0; i < own.mean.size(); i += 3) own.mean[i] += reach;
    }
    CHECK(error_against(children.view(), own.view(), page.error) > 5 * page.error);
  }
}

TEST_CASE("where nothing is simplified, or nothing can be seen, the error is 0") {
  SplatCloud wall = small_wall(8);
  CHECK(error_against(wall.view(), wall.view(), 1e-30F) == 0);
  const SplatCloud one = rows(wall, 3, 1), other = rows(wall, 4, 1);
  CHECK(error_against(one.view(), one.view(), 1e-30F) == 0);
  CHECK(error_against(one.view(), other.view(), 1e-30F) == 0);
  for (float& logit : wall.opacity_logit) logit = -30;
  const SplatCloud some = rows(wall, 0, 16);
  CHECK(error_against(wall.view(), some.view(), 1e-30F) == 0);
}

TEST_CASE("Gaussians that are too far or too large for the builder take no part") {
  SplatCloud wall = small_wall(32);
  rgs::Splat far = wall.view().splat(0);
  far.mean[0] = 3e20F;
  wall.set(0, far);
  rgs::Splat large = wall.view().splat(1);
  large.log_scale[1] = 60;
  wall.set(1, large);
  const Levels levels = build_levels(wall.view(), {.chunk_size = 32, .page_chunks = 6});
  for (const Page& page : levels.pages) {
    if (page.n_children == 0) continue;
    const float measured = error_against(children_of(levels, page).view(), page_of(levels, page).view(), page.error);
    CHECK(measured < 3 * page.error);
  }
}
