// keep_levels.hpp - a file's own levels of detail as levels of an .rgs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "convert.hpp"
#include "rgs/encode.hpp"
#include "rgs/level_tree.hpp"
#include "rgs/scene_scan.hpp"
#include "stream_levels.hpp"

namespace rgs {

/// Leaves are the nodes without children, one after another, each along a Morton curve. Pages of a node share core and
/// error, so that they are drawn together. Where a node's level is not one above its children's, pages repeat the
/// children; levels that no node has are left out. Leaf pages are whole chunks: what is left to fill a node's last
/// chunk are those Gaussians of the next node that show least. Nodes of less than what is left are joined to the one
/// before. Above the coarsest nodes levels are built.
class KeptLevels {
 public:
  /// Reads all nodes once. `from`: the axes of the nodes; encode.axes are those of the result. Errors: the tree's,
  /// unsupported_feature (too many levels), bad_value and too_many_bad (damaged Gaussians above the leaves),
  /// host_out_of_memory.
  static Result<KeptLevels> open(LevelTree tree, const Axes& from, const EncodeOptions& encode);
  /// The tree's, with anti-aliasing and bytes.
  const SplatFile& file() const { return tree_.file; }
  /// Of all nodes.
  const MeanRounding& rounding() const { return rounding_; }
  /// All Gaussians but the leaves.
  const SceneScan& coarser() const { return coarser_; }
  /// The leaves, in the order of read_splats(). A view.
  lod::SplatStream leaves() const;
  /// In place of order_leaves() and build_upper(). Errors: theirs; unsupported_feature (the levels' sizes are none of a
  /// tree of pages), limit_exceeded (most Gaussians would be repeated).
  Status arrange(const SceneScan& scan, const EncodeOptions& encode, const lod::StreamOptions& options,
                 lod::StreamedLevels& out) const;

 private:
  Status read(const LevelTree::Visit& visit) const;
  LevelTree tree_;
  Axes from_, to_;
  std::vector<std::uint64_t> n_kept_;  // of each node, without damaged ones
  std::vector<bool> is_leaf_;
  int sh_degree_ = 0;
  MeanRounding rounding_;
  SceneScan coarser_{0};
};

}  // namespace rgs
