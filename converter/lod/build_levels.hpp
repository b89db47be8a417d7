// build_levels.hpp - levels of detail: from a scene's Gaussians to a tree of pages. Method and quality:
// docs/develop/LEVELS.md.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "rgs/page.hpp"
#include "rgs/splat_cloud.hpp"
#include "simplify.hpp"

namespace rgs::lod {

struct BuildOptions {
  Quality quality = Quality::fast;
  /// Fits `best`, with other roundings; null: the processor does. Callers of build_page() and of what calls it check its
  /// status().
  std::shared_ptr<FitDevice> device = nullptr;
  std::uint32_t chunk_size = 256;           ///< of the file: leaf pages consist of whole chunks
  std::uint32_t page_chunks = kPageChunks;  ///< most chunks of a page
  std::uint32_t children = 4;               ///< most of a page
  /// A scene of at least 1.5 stretches is built stretch by stretch up to level `stretch_levels`, and as a whole above
  /// it.
  std::uint32_t stretch_pages = 1024;  ///< whole leaf pages of a stretch; half as many must have two pages or more ...
  std::uint32_t stretch_levels = 4;    ///< ... at this level
};

/// Pages of one level in order, and their Gaussians page after page. Page::first counts within the level, `first_child`
/// within the level below; `parent` is not set.
struct Level {
  SplatCloud splats;
  std::vector<Page> pages;
};

/// The stages of build_levels(), for callers that build ranges or use several processes. Equal groups give equal bytes.

/// Boxes of a chunk's means, and of its Gaussians out to three standard deviations. Boxes of two parts of a chunk can
/// be added.
struct ChunkBoxes {
  Box means, bounds;
  ChunkBoxes();  ///< empty
  void add(const ChunkBoxes& other);
};
ChunkBoxes chunk_boxes(const SplatView& splats, std::uint64_t first, std::uint64_t n);
/// Leaf pages of `n` Gaussians in chunks with these boxes; cores are not set.
std::vector<Page> cut_chunks(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options);
/// Leaf pages of one stretch of Gaussians in the order of a file without levels: runs of at most page_chunks chunks,
/// shorter before a gap. All chunks but the last are whole.
std::vector<Page> cut_leaves(const SplatView& leaves, const BuildOptions& options);
/// What it costs to merge Gaussians of a page: fourth roots of the costs of each one's cheapest merge
/// (cheapest_merges()), at evenly spaced ranks, ascending.
using MergeCosts = std::array<float, 16>;
MergeCosts merge_costs(const SplatView& splats, std::uint64_t first, std::uint64_t n);
/// Consecutive pages first .. last - 1 of a level, of which one page with `wanted` Gaussians is made.
struct Group {
  std::uint32_t first, last;
  std::uint64_t wanted;
};
/// Groups of pages with these costs, one after the other. Together they want about kKept of all Gaussians, each as many as it
/// costs: where merges cost much, groups have fewer pages.
std::vector<Group> group_pages(std::span<const Page> pages, std::span<const MergeCosts> costs,
                               const BuildOptions& options);
inline constexpr double kKept = 0.22;
inline constexpr float kErrorGrowth = 1.01F;  ///< least ratio of a page's error to its children's largest
inline constexpr float kMostError = 1e30F;

/// Stretches: runs of leaves with levels of their own, so that processes can build them in parallel. They are cut by
/// count alone, and no page up to level BuildOptions::stretch_levels spans two.
/// Where the stretches of `n` leaves begin, n > 0; the last element is n. Stretches are whole chunks and equal but for
/// the last, which is half to one and a half times as long.
std::vector<std::uint64_t> cut_stretches(std::uint64_t n, const BuildOptions& options);
/// Leaf pages of all stretches, each by cut_chunks(). On return `stretches` holds the page at which each begins, and
/// the number of pages.
std::vector<Page> cut_leaf_pages(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options,
                                 std::vector<std::uint32_t>& stretches);
/// group_pages() of one level; below level stretch_levels by stretch. `stretches` holds where stretches begin among the
/// pages, on return among the groups.
std::vector<Group> group_stretches(std::span<const Page> pages, std::span<const MergeCosts> costs,
                                   std::vector<std::uint32_t>& stretches, const BuildOptions& options);
/// Builds one page from a group of `below`, whose Gaussians are `splats` (rows as Page::first says), and appends its
/// Gaussians to `out`. Memory: about 4 KiB per Gaussian of the group.
Page build_page(const SplatView& splats, std::span<const Page> below, const Group& group, const BuildOptions& options,
                SplatCloud& out);
/// All pages of the next level, one for each group, on the threads of the current arena.
Level build_level(const SplatView& splats, std::span<const Page> below, std::span<const Group> groups,
                  const BuildOptions& options);

/// Joins the pages of all levels, leaves first, into a tree: coarse to fine, with parents and children set.
std::vector<Page> join_levels(std::span<const std::vector<Page>> levels);

/// All levels of a scene, up to one page. `leaves`: consistent, finite, at least one Gaussian, in the order of a file
/// without levels. Same bytes for any number of threads. Memory: 1.4 times the leaves, twice that while the result is
/// joined, and a group per thread. Levels::quality_db is 0: Page::error promises no number of decibels, see
/// allowed_squared().
Levels build_levels(const SplatView& leaves, const BuildOptions& options = {});

}  // namespace rgs::lod
