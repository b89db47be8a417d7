// page.cpp - checks the tree of pages, and finds cuts.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/page.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

#include "rgs/footprint.hpp"

namespace rgs::lod {
namespace {

bool is_box(const Box& box) {
  for (std::size_t k = 0; k < 3; ++k) {
    if (!std::isfinite(box.min[k]) || !std::isfinite(box.max[k]) || box.min[k] > box.max[k]) return false;
  }
  return true;
}

bool contains(const Box& outer, const Box& inner) {
  for (std::size_t k = 0; k < 3; ++k) {
    if (inner.min[k] < outer.min[k] || inner.max[k] > outer.max[k]) return false;
  }
  return true;
}

// Pages that are drawn or have no children, in the order of leaves.
template <class IsDrawn>
std::vector<std::uint32_t> pages_until(const std::vector<Page>& pages, const IsDrawn& is_drawn) {
  std::vector<std::uint32_t> drawn;
  walk_pages(pages, [&](std::uint32_t i) {
    if (pages[i].n_children != 0 && !is_drawn(i)) return Walk::down;
    drawn.push_back(i);
    return Walk::on;
  });
  return drawn;
}

bool is_known(const std::vector<Page>& pages, std::uint64_t page) {
  return page < pages.size() && (pages[page].count != 0 || pages[page].parent != kNoPage);
}

// Whether all children of page i are known and among the first n_present.
bool has_present_children(const std::vector<Page>& pages, std::uint32_t i, std::uint32_t n_present) {
  const std::uint64_t end = std::uint64_t{pages[i].first_child} + pages[i].n_children;
  return pages[i].n_children != 0 && end <= n_present && end <= pages.size() && pages[end - 1].parent == i;
}

}  // namespace

std::vector<std::uint32_t> pages_of_level(const std::vector<Page>& pages, std::uint32_t level) {
  std::vector<std::uint32_t> of_level;
  for (std::size_t i = 0; i < pages.size(); ++i) {
    if (pages[i].level == level && is_known(pages, i)) of_level.push_back(static_cast<std::uint32_t>(i));
  }
  return of_level;
}

std::vector<std::uint32_t> finest_cut(const std::vector<Page>& pages, std::uint64_t max_count,
                                      std::uint32_t n_present) {
  // From the root downwards, largest error first, replaces each page by its children. Pages of equal error are replaced
  // together, as for any threshold.
  std::vector<std::uint32_t> by_error;
  for (std::size_t i = 0; i < pages.size(); ++i) {
    if (pages[i].n_children != 0) by_error.push_back(static_cast<std::uint32_t>(i));
  }
  std::ranges::stable_sort(by_error, std::ranges::greater(), [&](std::uint32_t i) { return pages[i].error; });
  float error = std::numeric_limits<float>::infinity();  // pages with at most this error are drawn
  bool found = pages.front().count <= max_count && n_present > 0;
  std::int64_t count = pages.front().count;
  for (std::size_t i = 0; i < by_error.size();) {
    const float split = pages[by_error[i]].error;
    bool present = true;
    for (; i < by_error.size() && pages[by_error[i]].error == split; ++i) {
      const Page& page = pages[by_error[i]];
      count -= page.count;
      for (std::uint32_t child = page.first_child; child < page.first_child + page.n_children; ++child) {
        if (child < n_present && child < pages.size() && pages[child].parent == by_error[i]) {
          count += pages[child].count;
        } else {
          present = false;
        }
      }
    }
    if (!present) break;
    if (static_cast<std::uint64_t>(count) <= max_count) {
      found = true;
      error = std::nextafter(split, 0.f);  // below this one's, and not below any descendant's
    }
  }
  if (!found) return {};
  return pages_until(pages, [&](std::uint32_t i) { return pages[i].error <= error; });
}

double footprint(const Box& core, const Eye& eye) {
  return pixel_footprint(core.min.data(), core.max.data(), eye.position.data(), eye.focal_px, eye.z_near);
}

std::vector<std::uint32_t> drawn_pages(const std::vector<Page>& pages, const Eye& eye, float detail_px,
                                       std::uint32_t n_present) {
  if (n_present == 0) return {};
  return pages_until(pages, [&](std::uint32_t i) {
    return !has_present_children(pages, i, n_present) ||
           is_fine_enough(pages[i].error, detail_px, footprint(pages[i].core, eye));
  });
}

DetailChoice finest_detail(const std::vector<Page>& pages, const Eye& eye, float detail_px, std::uint64_t max_gaussians,
                           std::uint32_t n_present) {
  if (n_present == 0) return {detail_px, 0};
  return finest_detail_of(pages, eye, detail_px, max_gaussians,
                          [&](std::uint32_t i) { return has_present_children(pages, i, n_present); });
}

PageFault check_page(const std::vector<Page>& pages, std::size_t index, std::uint32_t chunk_size,
                     std::uint32_t n_pages) {
  const std::size_t n = n_pages == kNoPage ? pages.size() : n_pages;
  const Page& page = pages[index];
  const bool root = index == 0, leaf = page.level == 0;
  if (page.count == 0) return {PageField::count, "a page has no Gaussians"};
  const bool last = index + 1 == n;
  if (leaf && !last && page.count % chunk_size != 0) {
    return {PageField::count, "a leaf page other than the last is not whole chunks"};
  }
  if (page.level >= kMaxLevels) return {PageField::level, "a page's level is above 63"};
  const Page* before = root || !is_known(pages, index - 1) ? nullptr : &pages[index - 1];
  if (before != nullptr && page.level != before->level && page.level + 1 != before->level) {
    return {PageField::level, "pages are not ordered by level, coarse to fine"};
  }
  if (root != (page.parent == kNoPage)) {
    return {PageField::parent,
            root ? "the first page has a parent: it must be the root" : "a second page has no parent"};
  }
  if (last && !leaf) return {PageField::level, "the last page is not a leaf"};
  if (leaf && (page.n_children != 0 || page.first_child != 0)) return {PageField::children, "a leaf page has children"};
  if (!leaf) {
    if (page.n_children == 0 || page.n_children > kMaxChildren) {
      return {PageField::children, "a page above the leaves does not have 1 to 255 children"};
    }
    // The level below starts after the last page of this one. Future children need no bookkeeping: what a level's first
    // page claims must follow what the level above claimed, which is this level.
    const std::uint64_t next = root ? 1 : before ? std::uint64_t{before->first_child} + before->n_children : 0;
    const std::uint64_t end = std::uint64_t{page.first_child} + page.n_children;
    const bool continues = before != nullptr && before->level == page.level, to_come = !is_known(pages, end - 1);
    if (page.first_child <= index || end > n || ((continues || to_come) && next > 0 && page.first_child != next)) {
      return {PageField::children, "the children of pages do not follow each other"};
    }
    for (std::uint64_t child = page.first_child; child < end; ++child) {
      if (is_known(pages, child) && pages[child].parent != index)
        return {PageField::children, "a page's child names another page as its parent"};
    }
  }
  if (!is_box(page.bounds)) return {PageField::bounds, "a page's box is not finite or has min > max"};
  if (!is_box(page.core)) return {PageField::core, "a page's core is not finite or has min > max"};
  if (!contains(page.bounds, page.core)) return {PageField::core, "a page's core reaches beyond its box"};
  if (!std::isfinite(page.error) || page.error < 0 || std::signbit(page.error) || (leaf && page.error != 0)) {
    return {PageField::error, "a page's error is negative or not finite, or that of a leaf is not 0"};
  }
  if (root) return {};
  if (page.parent >= index) return {PageField::parent, "a page's parent does not precede it"};
  const Page& parent = pages[page.parent];
  // Its siblings before it are known and have the same parent: no two pages can share children.
  const bool is_first = index == parent.first_child;
  if (index < parent.first_child || index - parent.first_child >= parent.n_children || page.level + 1 != parent.level ||
      (!is_first && pages[index - 1].parent != page.parent)) {
    return {PageField::parent, "a page is not a child of the page that it names as its parent"};
  }
  if (!contains(parent.bounds, page.bounds)) return {PageField::bounds, "a page's box reaches beyond its parent's"};
  if (!contains(parent.core, page.core)) return {PageField::core, "a page's core reaches beyond its parent's"};
  if (!(page.error < parent.error)) return {PageField::error, "a page's error is not less than its parent's"};
  return {};
}

Status check_pages(const std::vector<Page>& pages, std::uint32_t chunk_size) {
  if (pages.empty()) return make_error(Errc::bad_value, 0, "there are no pages");
  std::uint64_t first = 0;
  for (std::size_t i = 0; i < pages.size(); ++i) {
    const PageFault fault = check_page(pages, i, chunk_size);
    if (fault.what != nullptr) return make_error(Errc::bad_value, i, fault.what);
    if (pages[i].first != first) {
      return make_error(Errc::bad_value, i, "a page's Gaussians do not follow those of the page before", first,
                        pages[i].first);
    }
    first += pages[i].count;
  }
  return {};
}

}  // namespace rgs::lod
