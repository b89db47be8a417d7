// trivial_levels.hpp - the simplest levels of detail, for tests of files: every fourth Gaussian, twice as large.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "rgs/page.hpp"
#include "rgs/splat_cloud.hpp"

namespace rgs::test {

struct TrivialOptions {
  std::uint32_t chunk_size = 256;
  std::uint32_t page_chunks = lod::kPageChunks;
  std::uint32_t n_children = 4;
};

/// Levels over `leaves`, which are in file order. Boxes and cores hold means only: writers enlarge boxes as necessary.
inline lod::Levels trivial_levels(const SplatCloud& leaves, const TrivialOptions& options = {}) {
  struct Node {
    std::vector<Splat> splats;
    lod::Page page;
    std::uint32_t first_child = 0;  // in the level below
  };
  const auto describe = [](Node& node, const std::vector<Node>* below) {
    Box& box = node.page.bounds;
    for (std::size_t i = 0; i < node.splats.size(); ++i) {
      const Splat& s = node.splats[i];
      for (std::size_t k = 0; k < 3; ++k) {
        box.min[k] = i == 0 ? s.mean[k] : std::min(box.min[k], s.mean[k]);
        box.max[k] = i == 0 ? s.mean[k] : std::max(box.max[k], s.mean[k]);
      }
    }
    node.page.core = box;
    node.page.count = static_cast<std::uint32_t>(node.splats.size());
    if (below == nullptr) return;
    for (std::uint32_t c = 0; c < node.page.n_children; ++c) {
      const lod::Page& child = (*below)[node.first_child + c].page;
      for (std::size_t k = 0; k < 3; ++k) {
        box.min[k] = std::min(box.min[k], child.bounds.min[k]);
        box.max[k] = std::max(box.max[k], child.bounds.max[k]);
      }
      node.page.error = std::max({node.page.error, 2 * child.error, 0.001f});
    }
    node.page.core = box;
  };

  std::vector<std::vector<Node>> levels(1);
  const std::uint64_t rows = std::uint64_t{options.chunk_size} * options.page_chunks;
  for (std::uint64_t first = 0; first < leaves.size(); first += rows) {
    Node& node = levels[0].emplace_back();
    for (std::uint64_t i = first; i < std::min(leaves.size(), first + rows); ++i) {
      node.splats.push_back(leaves.view().splat(i));
    }
    describe(node, nullptr);
  }
  while (levels.back().size() > 1) {
    const auto level = static_cast<std::uint32_t>(levels.size());
    std::vector<Node> above;
    std::vector<Node>& below = levels.back();
    for (std::uint32_t first = 0; first < below.size(); first += options.n_children) {
      Node& node = above.emplace_back();
      node.first_child = first;
      node.page.level = level;
      node.page.n_children = std::min(options.n_children, static_cast<std::uint32_t>(below.size()) - first);
      std::uint64_t n = 0;
      for (std::uint32_t c = first; c < first + node.page.n_children; ++c) {
        for (const Splat& s : below[c].splats) {
          if (n++ % options.n_children != 0) continue;
          node.splats.push_back(s);
          for (float& value : node.splats.back().log_scale) value = std::min(value + 0.6931472f, 60.f);
        }
      }
      describe(node, &below);
    }
    levels.push_back(std::move(above));
  }

  lod::Levels result;
  std::vector<std::uint32_t> first_of_level(levels.size());
  std::uint32_t n_pages = 0;
  std::uint64_t n = 0;
  for (std::size_t level = levels.size(); level-- > 0;) {
    first_of_level[level] = n_pages;
    n_pages += static_cast<std::uint32_t>(levels[level].size());
    for (const Node& node : levels[level]) n += node.splats.size();
  }
  result.splats.resize(n, leaves.sh_degree);
  n = 0;
  for (std::size_t level = levels.size(); level-- > 0;) {
    for (std::size_t i = 0; i < levels[level].size(); ++i) {
      Node& node = levels[level][i];
      node.page.first = n;
      if (level != 0) node.page.first_child = first_of_level[level - 1] + node.first_child;
      if (level + 1 < levels.size()) {
        node.page.parent = first_of_level[level + 1] + static_cast<std::uint32_t>(i) / options.n_children;
      }
      for (const Splat& s : node.splats) result.splats.set(n++, s);
      result.pages.push_back(node.page);
    }
  }
  return result;
}

}  // namespace rgs::test
