// tree_pages.hpp - pages of an .rgs for formats that write its levels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "rgs/page.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs::detail {

/// Pages of one level, in order.
struct PageRun {
  std::vector<std::uint32_t> pages;
  std::uint64_t count = 0;  ///< Gaussians
};

/// Those of `level` below `page`, or itself.
inline PageRun pages_below(const std::vector<lod::Page>& tree, std::uint32_t page, std::uint32_t level) {
  PageRun run{{page}, 0};
  while (tree[run.pages.front()].level > level) {
    std::vector<std::uint32_t> children;
    for (const std::uint32_t i : run.pages) {
      for (std::uint32_t k = 0; k < tree[i].n_children; ++k) children.push_back(tree[i].first_child + k);
    }
    run.pages = std::move(children);
  }
  for (const std::uint32_t i : run.pages) run.count += tree[i].count;
  return run;
}

/// A box turned to other axes, then moved.
inline WorldBox turned_box(const Box& box, const Axes& from, const Axes& to, const Origin& move) {
  Origin low, high;
  for (std::size_t k = 0; k < 3; ++k) {
    low[k] = static_cast<double>(box.min[k]);
    high[k] = static_cast<double>(box.max[k]);
  }
  convert_axes(low, from, to);
  convert_axes(high, from, to);
  WorldBox turned;
  for (std::size_t k = 0; k < 3; ++k) {
    if (low[k] > high[k]) std::swap(low[k], high[k]);  // a mirrored axis
    turned.min[k] = low[k] + move[k];
    turned.max[k] = high[k] + move[k];
  }
  return turned;
}

}  // namespace rgs::detail
