// check_levels.hpp - a file's own levels of detail are a tree, whose leaves are what is read without levels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <span>
#include <string>
#include <vector>

#include "rgs/level_tree.hpp"

namespace rgs::test {

/// `n`: Gaussians that are read without levels.
inline void check_levels(std::span<const std::byte> bytes, const std::string& folder, std::uint64_t n) {
  const auto require = [](bool condition) {
    if (!condition) std::abort();
  };
  const auto tree = open_levels(bytes, folder, {});
  if (!tree || tree->nodes.empty()) return;
  std::uint64_t n_finest = 0;
  std::vector<bool> is_leaf(tree->nodes.size(), true);
  for (std::size_t i = tree->nodes.size(); i-- > 0;) {
    const LevelTree::Node& node = tree->nodes[i];
    n_finest += is_leaf[i] ? node.n : 0;
    if (node.parent == LevelTree::kNoParent) continue;
    require(node.parent < i && tree->nodes[node.parent].level > node.level);
    is_leaf[node.parent] = false;
  }
  require(n_finest == n);
  (void)tree->read([&](std::uint32_t node, const SplatFile& piece) -> Status {
    require(piece.cloud.size() == tree->nodes[node].n);
    return {};
  });
}

}  // namespace rgs::test
