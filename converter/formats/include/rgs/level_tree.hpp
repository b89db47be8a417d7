// level_tree.hpp - levels of detail that a file has of its own, read piece by piece.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "rgs/interchange.hpp"

namespace RGS_API rgs {

/// Trees of nodes: a region of streamed SOG is a chain of one node per level, that of the coarsest level first. The
/// nodes without children are together what read_splats() reads, in the order in which `read` visits them, or in that of
/// `source_index`.
struct LevelTree {
  static constexpr std::uint32_t kNoParent = ~std::uint32_t{0};
  struct Node {
    std::uint32_t level = 0;           ///< 0: the finest; below the parent's
    std::uint32_t parent = kNoParent;  ///< which its children together replace; comes before them
    std::uint64_t n = 0;               ///< Gaussians, at least 1
    float error = 0;  ///< as in FORMAT.md, world units a pixel; 0: not stated, and so is that of level 0
  };
  std::vector<Node> nodes;
  SplatFile file;  ///< all but `cloud`, aa_mode and position_rounding, which each piece has
  /// Receives the Gaussians of a node, in the axes and with the origin of the file, with their positions in what
  /// read_splats() reads as `source_index`, unless they follow those of the piece before. Bytes of pieces add to those of
  /// `file`.
  using Visit = std::function<Status(std::uint32_t node, SplatFile piece)>;
  /// Visits all nodes, always in the same order, until `visit` fails. Memory: that of one of the file's parts; of a .rad
  /// the tree itself holds all Gaussians.
  std::function<Status(const Visit& visit)> read = [](const Visit&) { return Status(); };
};

/// A .ssog, lod-meta.json, tileset.json, .rad, .lcc or .lcc2, `bytes`, which must outlive the result; `folder` holds files
/// beside it. Without nodes above others if the file has one level. Errors: as read_splats(), also from `read`.
Result<LevelTree> open_levels(std::span<const std::byte> bytes, const std::string& folder, const ReadOptions& options);

}  // namespace rgs
