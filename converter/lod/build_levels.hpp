// build_levels.hpp - levels of detail: from a scene's Gaussians to a tree of pages. docs/develop/LEVELS.md says how and how well.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "rgs/page.hpp"
#include "rgs/splat_cloud.hpp"
#include "simplify.hpp"

namespace rgs::lod {

enum class Quality : std::uint8_t {
  fast,  ///< a start in closed form and a few steps of optimisation
  best,  ///< many steps
};

struct BuildOptions {
  Quality quality = Quality::fast;
  std::uint32_t chunk_size = 256;           ///< of the file: leaf pages are whole chunks
  std::uint32_t page_chunks = kPageChunks;  ///< most chunks of a page
  std::uint32_t children = 4;               ///< most pages that become one, of less than a quarter as many Gaussians
  /// A scene of 1.5 stretches and more is built stretch by stretch up to level `stretch_levels`, and as a whole above it.
  std::uint32_t stretch_pages = 1024;  ///< whole leaf pages of a stretch; half as many must have two pages or more ...
  std::uint32_t stretch_levels = 4;    ///< ... at this level
};
FitOptions fit_options(Quality quality);

/// Pages of one level, in order, and their Gaussians one page after the other. Page::first counts within the level;
/// `parent` is not set, `first_child` counts within the level below.
struct Level {
  SplatCloud splats;
  std::vector<Page> pages;
};

/// The stages of build_levels(), for callers that build a range at a time or in several processes. Pages know nothing of
/// their neighbours but through group_pages(): whoever groups the same pages gets the same bytes.

/// Boxes of a chunk: of its means, and of all that is in it out to three standard deviations. Those of two parts of a chunk
/// may be added up.
struct ChunkBoxes {
  Box means, bounds;
  ChunkBoxes();  ///< of nothing
  void add(const ChunkBoxes& other);
};
ChunkBoxes chunk_boxes(const SplatView& splats, std::uint64_t first, std::uint64_t n);
/// Leaf pages of `n` Gaussians in chunks that have these boxes; their cores are left open.
std::vector<Page> cut_chunks(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options);
/// Leaf pages of one stretch of Gaussians in the order of a file without levels; runs of at most page_chunks chunks, shorter
/// before a gap. All chunks but the last are whole.
std::vector<Page> cut_leaves(const SplatView& leaves, const BuildOptions& options);
/// Where groups of consecutive pages begin, and as last element where the last one ends.
std::vector<std::uint32_t> group_pages(std::span<const Page> pages, const BuildOptions& options);

/// Stretches: runs of leaves of which each has levels of its own, so that processes may build them side by side. They are cut by
/// count alone, and no page reaches from one into the next up to level BuildOptions::stretch_levels.
/// Where the stretches of `n` leaves begin, n > 0, and as last element n: whole chunks, and equal but for the last one, which is
/// half to one and a half times as long as the others.
std::vector<std::uint64_t> cut_stretches(std::uint64_t n, const BuildOptions& options);
/// Leaf pages of all stretches, as cut_chunks() of each. `stretches` becomes the page at which each begins, and the number of pages.
std::vector<Page> cut_leaf_pages(std::span<const ChunkBoxes> chunks, std::uint64_t n, const BuildOptions& options,
                                 std::vector<std::uint32_t>& stretches);
/// group_pages() of the pages of one level, of each stretch by itself below level stretch_levels; `stretches`, which says where
/// they begin among the pages, then says it of the groups.
std::vector<std::uint32_t> group_stretches(std::span<const Page> pages, std::vector<std::uint32_t>& stretches,
                                           const BuildOptions& options);
/// One page for pages first .. last - 1 of `below`, whose Gaussians are `splats` (rows as Page::first says). Its Gaussians
/// are appended to `out`. Memory: about 4 KiB a Gaussian of the group.
Page build_page(const SplatView& splats, std::span<const Page> below, std::uint32_t first, std::uint32_t last,
                const BuildOptions& options, SplatCloud& out);
/// All pages of the level above, one for each group that begins at `begins`, on the threads of the current arena.
Level build_level(const SplatView& splats, std::span<const Page> below, std::span<const std::uint32_t> begins,
                  const BuildOptions& options);

/// Pages of all levels, leaves first, as a tree: coarse to fine, with the numbers of parents and children set.
std::vector<Page> join_levels(std::span<const std::vector<Page>> levels);

/// All levels of a scene, up to one page. `leaves`: consistent, finite, at least one Gaussian, in the order of a file without
/// levels. Same bytes for any number of threads. Memory: 1.4 times the leaves', twice while the result is put together, and
/// that of a group a thread. Levels::quality_db is 0: what Page::error promises is relative, see allowed_squared().
Levels build_levels(const SplatView& leaves, const BuildOptions& options = {});

}  // namespace rgs::lod
