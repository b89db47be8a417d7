// build_levels_test.cpp - the tree of pages: invariants for scenes of all sizes and kinds.
// SPDX-License-Identifier: Apache-2.0
#include "build_levels.hpp"

#include <doctest/doctest.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include "complexity.hpp"
#include "core_box.hpp"
#include "lod_scenes.hpp"
#include "plausible_cloud.hpp"

namespace {

using namespace rgs::lod;

BuildOptions small_pages() {
  BuildOptions options;
  options.chunk_size = 64;
  options.page_chunks = 4;
  return options;
}

void check_levels(const Levels& levels, const rgs::SplatCloud& leaves, const BuildOptions& options) {
  const auto checked = check_pages(levels.pages, options.chunk_size);
  const char* const why = checked ? "" : checked.error().what;
  INFO(why);
  REQUIRE(checked.has_value());
  REQUIRE(levels.n_leaves() == leaves.size());
  REQUIRE(levels.splats.view().consistent());
  // Leaves come last, unchanged.
  const auto tail = [](const std::vector<float>& all, const std::vector<float>& part) {
    return std::equal(part.begin(), part.end(), all.end() - static_cast<std::ptrdiff_t>(part.size()));
  };
  CHECK(tail(levels.splats.mean, leaves.mean));
  CHECK(tail(levels.splats.log_scale, leaves.log_scale));
  CHECK(tail(levels.splats.rotation, leaves.rotation));
  CHECK(tail(levels.splats.opacity_logit, leaves.opacity_logit));
  CHECK(tail(levels.splats.sh, leaves.sh));
  for (const Page& page : levels.pages) {
    CHECK(page.count <= options.chunk_size * options.page_chunks);
    if (page.level == 0) continue;
    std::uint64_t below = 0;
    for (std::uint32_t k = 0; k < page.n_children; ++k) below += levels.pages[page.first_child + k].count;
    CHECK(page.count <= std::max<std::uint64_t>(1, below * 3 / 4));
  }
  // Bounds hold three standard deviations of the page's Gaussians, along each axis of the Gaussian.
  for (const Page& page : levels.pages) {
    for (std::uint64_t i = page.first; i < page.first + page.count; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        const float mean = levels.splats.mean[3 * i + k];
        float least = 1e30F;  // a ball inside the ellipsoid
        for (std::size_t l = 0; l < 3; ++l) least = std::min(least, 3 * std::exp(levels.splats.log_scale[3 * i + l]));
        REQUIRE(page.bounds.min[k] <= mean - least);
        REQUIRE(page.bounds.max[k] >= mean + least);
      }
    }
  }
  // A leaf's core follows from its Gaussians; a parent's joins its children's.
  for (const Page& page : levels.pages) {
    rgs::Box core = page.core;
    if (page.level == 0) {
      core = core_of(levels.splats.view(), page.first, page.count);
    } else {
      core = levels.pages[page.first_child].core;
      for (std::uint32_t i = page.first_child; i < page.first_child + page.n_children; ++i) {
        for (std::size_t k = 0; k < 3; ++k) {
          core.min[k] = std::min(core.min[k], levels.pages[i].core.min[k]);
          core.max[k] = std::max(core.max[k], levels.pages[i].core.max[k]);
        }
      }
    }
    CHECK(page.core.min == core.min);
    CHECK(page.core.max == core.max);
  }
  for (const float x : levels.splats.log_scale) REQUIRE(std::isfinite(x));
  for (const float x : levels.splats.opacity_logit) REQUIRE(std::isfinite(x));
}

std::vector<MergeCosts> costs_of(const rgs::SplatView& splats, const std::vector<Page>& pages) {
  std::vector<MergeCosts> costs;
  for (const Page& page : pages) costs.push_back(merge_costs(splats, page.first, page.count));
  return costs;
}

}  // namespace

TEST_CASE("levels of scenes of all sizes and degrees form a tree with unchanged leaves") {
  for (const std::uint64_t n : {1U, 2U, 63U, 64U, 65U, 256U, 257U, 1024U, 1025U, 5000U}) {
    for (const int degree : {0, 3}) {
      rgs::test::SplitMix random(n + static_cast<std::uint64_t>(degree));
      const rgs::SplatCloud cloud = rgs::test::plausible_cloud(n, degree, random);
      INFO("n ", n, " degree ", degree);
      const Levels levels = build_levels(cloud.view(), small_pages());
      check_levels(levels, cloud, small_pages());
      CHECK(levels.splats.size() <= n + n / 2 + 16);
    }
  }
}

TEST_CASE("levels are the same bytes on one thread, on two, and page by page") {
  rgs::test::SplitMix random(5);
  const rgs::SplatCloud cloud = rgs::test::wall(96, 1, random);
  const BuildOptions options = small_pages();
  Levels one, two;
  tbb::task_arena(1).execute([&] { one = build_levels(cloud.view(), options); });
  tbb::task_arena(2).execute([&] { two = build_levels(cloud.view(), options); });
  CHECK(one.splats.mean == two.splats.mean);
  CHECK(one.splats.log_scale == two.splats.log_scale);
  CHECK(one.splats.rotation == two.splats.rotation);
  CHECK(one.splats.opacity_logit == two.splats.opacity_logit);
  CHECK(one.splats.sh == two.splats.sh);
  // A page alone, as another process would build it.
  const std::vector<Page> leaves = cut_leaves(cloud.view(), options);
  const std::vector<Group> groups = group_pages(leaves, costs_of(cloud.view(), leaves), options);
  REQUIRE(groups.size() > 2);
  rgs::SplatCloud alone;
  const Page page = build_page(cloud.view(), leaves, groups[2], options, alone);
  const Level level = build_level(cloud.view(), leaves, groups, options);
  REQUIRE(level.pages[2].count == page.count);
  CHECK(level.pages[2].error == page.error);
  CHECK(std::equal(alone.mean.begin(), alone.mean.end(),
                   level.splats.mean.begin() + static_cast<std::ptrdiff_t>(3 * level.pages[2].first)));
}

TEST_CASE("where merging costs more, groups have fewer pages and keep more, and all of them a fixed share") {
  rgs::test::SplitMix random(11);
  rgs::SplatCloud cloud = rgs::test::wall(96, 0, random);  // 9,216 Gaussians, row after row
  const std::uint64_t half = cloud.size() / 2;
  for (std::uint64_t i = 0; i < half; ++i) cloud.opacity_logit[i] = -4;  // hardly visible
  const BuildOptions options = small_pages();
  const std::vector<Page> leaves = cut_leaves(cloud.view(), options);
  const std::vector<Group> groups = group_pages(leaves, costs_of(cloud.view(), leaves), options);
  double wanted[2] = {}, pages[2] = {}, n_groups[2] = {};
  for (const Group& group : groups) {
    const int is_costly = leaves[group.first].first >= half ? 1 : 0;
    wanted[is_costly] += static_cast<double>(group.wanted);
    pages[is_costly] += group.last - group.first;
    ++n_groups[is_costly];
    CHECK(group.wanted <= options.chunk_size * options.page_chunks);
  }
  CHECK((wanted[0] + wanted[1]) / static_cast<double>(cloud.size()) == doctest::Approx(kKept).epsilon(0.05));
  CHECK(wanted[1] > 2 * wanted[0]);
  CHECK(pages[0] / n_groups[0] > 3.5);
  CHECK(pages[1] / n_groups[1] < 3);
}

TEST_CASE("equal Gaussians, invisible ones and a huge one take no share from the others") {
  rgs::test::SplitMix random(12);
  const rgs::SplatCloud wall = rgs::test::wall(64, 0, random);  // 4,096 Gaussians
  const BuildOptions options = small_pages();
  for (const int kind : {0, 1, 2}) {
    CAPTURE(kind);
    rgs::SplatCloud cloud = wall;
    const std::uint64_t half = cloud.size() / 2;
    for (std::uint64_t i = 0; i < half; ++i) {
      if (kind == 0 && i % 2 != 0) cloud.set(i, cloud.view().splat(i - 1));
      if (kind == 1) cloud.opacity_logit[i] = -std::numeric_limits<float>::max();
      if (kind == 2 && i % 256 == 100) cloud.log_scale[3 * i] = 60;
    }
    const std::vector<Page> leaves = cut_leaves(cloud.view(), options);
    double wanted = 0, of_others = 0;
    for (const Group& group : group_pages(leaves, costs_of(cloud.view(), leaves), options)) {
      wanted += static_cast<double>(group.wanted);
      if (leaves[group.first].first >= half) of_others += static_cast<double>(group.wanted);
    }
    CHECK(wanted < 0.25 * static_cast<double>(cloud.size()));
    CHECK(of_others > 0.2 * static_cast<double>(half));
  }
}

TEST_CASE("pages are grouped by place where that halves their number, else by order") {
  const BuildOptions options = small_pages();
  std::vector<Page> pages(3);
  for (std::uint32_t i = 0; i < 3; ++i) {
    const float x = i == 2 ? 1000 : static_cast<float>(i);
    pages[i].count = 256;
    pages[i].bounds = {{x, 0, 0}, {x + 1, 1, 1}};
  }
  MergeCosts equal;
  equal.fill(1);
  const std::vector<MergeCosts> costs(3, equal);
  const std::vector<Group> pair_and_one = group_pages(pages, costs, options);
  REQUIRE(pair_and_one.size() == 2);
  CHECK(pair_and_one[0].last == 2);
  CHECK(group_pages(std::span(pages).subspan(1), std::span(costs).subspan(1), options).size() == 1);  // else no end
}

TEST_CASE("stretches are whole chunks of similar size, whatever the number of Gaussians") {
  BuildOptions options = small_pages();
  options.stretch_pages = 4;  // 1,024 Gaussians
  for (const std::uint64_t n : {1U, 64U, 1535U, 1536U, 1537U, 2048U, 2559U, 2560U, 100'000U, 100'001U}) {
    CAPTURE(n);
    const std::vector<std::uint64_t> begins = cut_stretches(n, options);
    CHECK(begins.front() == 0);
    CHECK(begins.back() == n);
    for (std::size_t i = 0; i + 2 < begins.size(); ++i) CHECK(begins[i + 1] - begins[i] == 1024);
    const std::uint64_t last = begins.back() - begins[begins.size() - 2];
    CHECK(last < 1536);
    if (n >= 512) CHECK(last >= 512);
  }
  // Files of large scenes depend on it.
  CHECK(cut_stretches(2'359'295, {}).size() == 2);
  CHECK(cut_stretches(2'359'296, {}) == std::vector<std::uint64_t>{0, 1'572'864, 2'359'296});
}

TEST_CASE("the levels of a stretch equal those of a scene of its own, up to where stretches meet") {
  rgs::test::SplitMix random(8);
  const rgs::SplatCloud cloud = rgs::test::wall(82, 1, random);  // 6,724
  BuildOptions options = small_pages();
  options.stretch_pages = 7;  // 1,792 Gaussians: four stretches, whose ends match no group of four pages
  options.stretch_levels = 1;
  const Levels whole = build_levels(cloud.view(), options);
  check_levels(whole, cloud, options);
  const std::vector<std::uint32_t> pages = pages_of_level(whole.pages, 1);
  std::size_t next = 0;
  const std::vector<std::uint64_t> begins = cut_stretches(cloud.size(), options);
  REQUIRE(begins.size() == 5);
  for (std::size_t i = 0; i < 4; ++i) {
    rgs::SplatCloud part;
    part.resize(begins[i + 1] - begins[i], cloud.sh_degree);
    for (std::uint64_t k = 0; k < part.size(); ++k) part.set(k, cloud.view().splat(begins[i] + k));
    const std::vector<Page> leaves = cut_leaves(part.view(), options);
    const Level level =
        build_level(part.view(), leaves, group_pages(leaves, costs_of(part.view(), leaves), options), options);
    REQUIRE(level.pages.size() >= 2);
    for (const Page& page : level.pages) {
      REQUIRE(next < pages.size());
      const Page& found = whole.pages[pages[next++]];
      REQUIRE(found.count == page.count);
      CHECK(found.error == page.error);
      CHECK(found.bounds.min == page.bounds.min);
      CHECK(found.core.max == page.core.max);
      const auto at = [](const rgs::SplatCloud& splats, std::uint64_t row) {
        return splats.mean.begin() + static_cast<std::ptrdiff_t>(3 * row);
      };
      CHECK(std::equal(at(level.splats, page.first), at(level.splats, page.first + page.count),
                       at(whole.splats, found.first)));
    }
  }
  CHECK(next == pages.size());
}

TEST_CASE("a distant floater gets its own page") {
  rgs::test::SplitMix random(6);
  rgs::SplatCloud cloud = rgs::test::wall(64, 0, random);
  const BuildOptions options = small_pages();
  // The last chunk is spread over a thousand times the wall's size.
  for (std::uint64_t i = cloud.size() - options.chunk_size; i < cloud.size(); ++i) {
    for (std::size_t k = 0; k < 3; ++k) cloud.mean[3 * i + k] = random.dyadic(-500, 500);
  }
  const std::vector<Page> pages = cut_leaves(cloud.view(), options);
  CHECK(pages.back().count == options.chunk_size);
  CHECK(pages[pages.size() - 2].bounds.max[0] < 2);
  check_levels(build_levels(cloud.view(), options), cloud, options);
}

TEST_CASE("levels accept Gaussians of any distance and size") {
  const BuildOptions options = small_pages();
  for (const float farthest : {1e9F, 3e10F, 1e12F, 1e19F, 1e37F, 3e38F}) {
    for (const std::uint64_t n_far : {1U, 3U, 300U, 4096U}) {
      for (const float log_scale : {-5.F, 20.F, 60.F}) {
        INFO("farthest ", farthest, " far ", n_far, " log_scale ", log_scale);
        rgs::test::SplitMix random(n_far);
        rgs::SplatCloud cloud = rgs::test::wall(64, 0, random);
        for (std::uint64_t j = 0; j < n_far; ++j) {
          const std::uint64_t i = j * cloud.size() / n_far;
          for (std::size_t k = 0; k < 3; ++k) cloud.mean[3 * i + k] = farthest * random.dyadic(-1, 1);
          cloud.log_scale[3 * i + j % 3] = log_scale;
        }
        const Levels levels = build_levels(cloud.view(), options);
        check_levels(levels, cloud, options);
        for (const float x : levels.splats.mean) REQUIRE(std::isfinite(x));
        for (const float x : levels.splats.rotation) REQUIRE(std::isfinite(x));
      }
    }
  }
}

// Four leaves of 1,024 Gaussians in all, with huge boxes.
std::vector<Page> wide_leaves() {
  std::vector<Page> leaves(4);
  for (std::uint64_t i = 0; i < 4; ++i) {
    leaves[i].first = 256 * i;
    leaves[i].count = 256;
    leaves[i].bounds = {{-1e38F, -1e38F, -1e38F}, {1e38F, 1e38F, 1e38F}};
  }
  return leaves;
}

TEST_CASE("a Gaussian far from a group survives and does not spoil the group") {
  const BuildOptions options = small_pages();
  rgs::test::SplitMix random(8);
  rgs::SplatCloud cloud = rgs::test::wall(32, 0, random);  // 1,024 in four pages, which are merged into one
  const Levels without = build_levels(cloud.view(), options);
  for (const std::uint64_t at : {0U, 500U}) {
    rgs::SplatCloud with = cloud;
    for (std::size_t k = 0; k < 3; ++k) with.mean[3 * at + k] = -1e37F;
    rgs::SplatCloud root;
    const Page page = build_page(with.view(), wide_leaves(), {0, 4, 225}, options, root);
    CHECK(page.count == without.pages.front().count);
    CHECK(page.error == doctest::Approx(without.pages.front().error).epsilon(0.1));
    CHECK(std::count(root.mean.begin(), root.mean.end(), -1e37F) == 3);
    CHECK(std::count_if(root.mean.begin(), root.mean.end(), [](float x) { return x > 0.5F && x < 1.5F; }) >
          page.count / 2);  // x of the right half and y of the lower one
  }
}

TEST_CASE("a scene far from one of its Gaussians is still simplified") {
  const BuildOptions options = small_pages();
  rgs::test::SplitMix random(9);
  rgs::SplatCloud cloud = rgs::test::wall(32, 0, random);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    for (std::size_t k = 0; k < 3; ++k) {
      cloud.mean[3 * i + k] = 2e10F + 1e6F * cloud.mean[3 * i + k];
      cloud.log_scale[3 * i + k] += std::log(1e6F);
    }
  }
  for (const std::uint64_t at : {0U, 500U}) {
    rgs::SplatCloud with = cloud;
    for (std::size_t k = 0; k < 3; ++k) with.mean[3 * at + k] = 0;
    rgs::SplatCloud root;
    const Page page = build_page(with.view(), wide_leaves(), {0, 4, 225}, options, root);
    // Merged Gaussians are larger than the originals.
    const float largest = *std::max_element(with.log_scale.begin(), with.log_scale.end());
    std::uint64_t n_merged = 0;
    for (std::uint64_t i = 0; i < page.count; ++i) {
      const float* scale = &root.log_scale[3 * i];
      n_merged += std::max({scale[0], scale[1], scale[2]}) > largest ? 1U : 0U;
    }
    CHECK(n_merged > page.count / 2);
  }
}

TEST_CASE("levels accept equal and invisible Gaussians") {
  const BuildOptions options = small_pages();
  rgs::SplatCloud cloud;
  cloud.resize(2000, 0);
  cloud.rotation.assign(cloud.rotation.size(), 0.5F);
  check_levels(build_levels(cloud.view(), options), cloud, options);
  cloud.opacity_logit.assign(cloud.opacity_logit.size(), -20);
  check_levels(build_levels(cloud.view(), options), cloud, options);
  cloud.log_scale.assign(cloud.log_scale.size(), -60);
  check_levels(build_levels(cloud.view(), options), cloud, options);
}

TEST_CASE("growth: building levels is linear in the Gaussians") {
  const double growth = rgs::test::growth(
      1024,
      [](std::uint64_t n) {
        rgs::test::SplitMix random(8);
        return rgs::test::wall(static_cast<std::uint64_t>(std::lround(std::sqrt(static_cast<double>(n)))), 0, random);
      },
      [](const rgs::SplatCloud& cloud) { build_levels(cloud.view(), small_pages()); });
  CHECK(growth < 48);
}
