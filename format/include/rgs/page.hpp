// page.hpp - levels of detail: a scene as a tree of pages, in memory. docs/format/FORMAT.md "Levels of detail".
//
// Leaves are the scene's Gaussians in the order of a file without levels. Every other page approximates its children,
// up to one root. A drawn page replaces all its descendants.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "rgs/footprint.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"

namespace RGS_API rgs {
namespace lod {

inline constexpr std::uint32_t kNoPage = std::numeric_limits<std::uint32_t>::max();

/// Chunks a page by default: 1,536 Gaussians, 114 KiB in the GPU's layout at SH degree 3.
inline constexpr std::uint32_t kPageChunks = 6;
inline constexpr std::uint32_t kMaxPageChunks = 1024;    ///< in a file
inline constexpr std::uint32_t kMaxPageRows = 1u << 16;  ///< Gaussians a page
inline constexpr std::uint32_t kMaxLevels = 64;
inline constexpr std::uint32_t kMaxChildren = 255;

/// A node of the tree. Pages are ordered coarse to fine: the root is page 0, then come the pages of the level below it,
/// and so on; within a level they are in the order of their leaves. So a page's children are consecutive, and the pages
/// of a level are the children of the level above, in order.
struct Page {
  std::uint32_t level = 0;         ///< 0: leaves; a child's level is one less than its parent's
  std::uint32_t parent = kNoPage;  ///< kNoPage: the root
  std::uint32_t first_child = 0;   ///< 0 in a leaf
  std::uint32_t n_children = 0;    ///< 0 in a leaf, else 1 to kMaxChildren
  std::uint64_t first = 0;         ///< first Gaussian, counted over all pages in order
  std::uint32_t count = 0;         ///< Gaussians of the page itself, at least 1
  /// Holds every Gaussian of the page and its descendants out to 3 standard deviations. Relative to the origin.
  Box bounds;
  /// Holds most of what shows of the page and its descendants; footprints are measured to it. Inside the bounds and
  /// inside the parent's core, so that footprints do not grow towards the root.
  Box core;
  /// Footprint of a pixel, world units, from which on the page may replace its descendants: 0 in a leaf, else finite
  /// and greater than in each child.
  float error = 0;
};

/// A scene with all its levels.
struct Levels {
  SplatCloud splats;        ///< of all pages in order: page i is rows first .. first + count - 1
  std::vector<Page> pages;  ///< coarse to fine
  /// Quality that Page::error promises, dB: PSNR of the page's picture against its descendants'. 0: not stated.
  float quality_db = 0;

  std::uint64_t n_leaves() const {  ///< Gaussians of the leaves, which are the last rows of `splats`
    std::uint64_t n = 0;
    for (const Page& page : pages) n += page.level == 0 ? page.count : 0;
    return n;
  }
};

// Of a tree that is not whole yet (PagedFile::open_beginning()), pages beyond `pages` and those that have neither a
// parent nor Gaussians are unknown, and count as absent.

enum class Walk : std::uint8_t { down, on, end };
/// Visits pages from the root on, in the order of leaves. visit(page) says what follows: the page's children, which are
/// known; what is behind it; or nothing.
template <class Visit>
void walk_pages(const std::vector<Page>& pages, const Visit& visit) {
  for (std::uint32_t i = 0;; ++i) {
    for (Walk next = visit(i); next != Walk::on; next = visit(i)) {
      if (next == Walk::end) return;
      i = pages[i].first_child;
    }
    for (;; i = pages[i].parent) {
      if (i == 0) return;
      const Page& above = pages[pages[i].parent];
      if (i + 1 < above.first_child + above.n_children) break;
    }
  }
}

/// Pages of one level, in order: what is drawn at that level. Level 0: the leaves.
std::vector<std::uint32_t> pages_of_level(const std::vector<Page>& pages, std::uint32_t level);

/// The finest cut of at most `max_count` Gaussians, by a threshold e: pages with error at most e whose parent's exceeds
/// it. In the order of leaves. Empty if the root alone exceeds max_count. `n_present`: pages that may be used, from the
/// root on.
std::vector<std::uint32_t> finest_cut(const std::vector<Page>& pages, std::uint64_t max_count,
                                      std::uint32_t n_present = kNoPage);

/// A viewpoint, for footprints.
struct Eye {
  std::array<double, 3> position;  ///< relative to the scene's origin, world units
  double focal_px = 1;             ///< the larger focal length
  double z_near = 0;               ///< nearer pages count as this near, world units
};
/// World units that a pixel covers at the point of a page's core nearest to the eye.
double footprint(const Box& core, const Eye& eye);
/// The cut of a view at a detail of `detail_px` >= 0, in the order of leaves: pages whose error is at most detail_px
/// times the footprint of their core, while their parent's exceeds it. 0: the leaves. A page whose children are not all
/// among the first `n_present` is drawn instead of them.
std::vector<std::uint32_t> drawn_pages(const std::vector<Page>& pages, const Eye& eye, float detail_px,
                                       std::uint32_t n_present = kNoPage);

/// A detail, and the Gaussians of its cut.
struct DetailChoice {
  float detail_px = 0;
  std::uint64_t gaussians = 0;
};
/// The finest of detail_steps(detail_px) whose cut has at most `max_gaussians`; if there is none, the finest whose cut
/// is the root. Counts what lies outside the picture too, so turning the camera changes nothing. Allocates nothing.
DetailChoice finest_detail(const std::vector<Page>& pages, const Eye& eye, float detail_px, std::uint64_t max_gaussians,
                           std::uint32_t n_present = kNoPage);
/// The same where has_children(page) says whether a page's children may be drawn.
template <class HasChildren>
DetailChoice finest_detail_of(const std::vector<Page>& pages, const Eye& eye, float detail_px,
                              std::uint64_t max_gaussians, const HasChildren& has_children) {
  const DetailSteps steps = detail_steps(detail_px);
  unsigned long long changes[kDetailSteps] = {};
  std::array<int, kMaxLevels> end_of = {};  // of pages of a level: the step at which the parent is drawn
  end_of[pages.front().level] = kDetailSteps;
  int root_step = 0;
  walk_pages(pages, [&](std::uint32_t i) {
    const Page& page = pages[i];
    const bool is_last = !has_children(i);
    const int end = end_of[page.level];
    const int fine = is_last ? 0 : first_fine_step(steps, page.error, footprint(page.core, eye));
    const int begin = fine < end ? fine : end;
    if (i == 0) root_step = begin;
    changes[begin] += page.count;
    if (end < kDetailSteps) changes[end] -= page.count;
    if (is_last || begin == 0) return Walk::on;
    end_of[page.level - 1] = begin;
    return Walk::down;
  });
  DetailChoice choice;
  unsigned long long gaussians = 0;
  choice.detail_px = steps.px[finest_fitting_step(changes, root_step, max_gaussians, gaussians)];
  choice.gaussians = gaussians;
  return choice;
}

/// A defect of a page and its field; without a defect `what` is null.
enum class PageField : std::uint8_t { count, level, parent, children, bounds, core, error };
struct PageFault {
  PageField field = PageField::count;
  const char* what = nullptr;
};
/// Checks page `index` against its parent and the pages before it, as far as they are known; a tree is sound if all its
/// pages are. `n_pages`: of the whole tree, if `pages` are the first of it; kNoPage: there are no more.
PageFault check_page(const std::vector<Page>& pages, std::size_t index, std::uint32_t chunk_size,
                     std::uint32_t n_pages = kNoPage);

/// Checks all pages, and Page::first. `chunk_size`: leaves but the last are whole chunks. Errors: bad_value; `offset`
/// is the page's index.
Status check_pages(const std::vector<Page>& pages, std::uint32_t chunk_size);

}  // namespace lod
}  // namespace rgs
