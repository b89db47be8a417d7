// front_end.hpp - launches that turn attributes into unsorted (tile, Gaussian) pairs, in one kernel or in three.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/cut.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Output arrays of pairs. A pair's key and value have the same index; keys are 32 bits wide if v.key.bits() <= 32 and
/// `narrow_keys`, else 64.
struct PairArrays {
  void* keys;                ///< [capacity]
  std::uint32_t* gaussians;  ///< [capacity]
  std::uint64_t capacity;
  bool narrow_keys;
};

/// One fused kernel (the paper, III-A3): projects Gaussians to n splats, n_copies(v.view) of each, writes splats [n]
/// and pairs of the visible ones, and adds to counters.instances and .visible. Pairs beyond the capacity are counted,
/// not written. If `block_state` is null, blocks get offsets by an atomic addition, in the order in which they run; if
/// it is [fused_blocks(n) + 1], zeroed before, pairs lie in the order of the splats on every run (chained scan, Merrill
/// and Garland 2016). Of PagedAttributes, projects the rows of `drawn`. Errors: device_failed.
struct FusedArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  math::Extent extent;
  ScreenSplat* splats;
  PairArrays pairs;
  Counters* counters;
  std::uint64_t* block_state;
  DrawnChunks drawn = {};
};
Status launch_fused(const FusedArguments& arguments, Stream stream);
std::uint32_t fused_blocks(std::uint32_t n);

/// The original's kernels. The first projects Gaussians, or rows of `drawn`, to n splats as above, and writes splats
/// [n], covers [n] and tiles touched [n], 0 if not drawn. Errors: device_failed.
struct ProjectArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  math::Extent extent;
  ScreenSplat* splats;
  void* covers;          ///< [n] of cover_bytes()
  std::uint32_t* tiles;  ///< [n]
  Counters* counters;    ///< .visible
  DrawnChunks drawn = {};
};
Status launch_project(const ProjectArguments& arguments, Stream stream);
std::uint64_t cover_bytes();

/// The third, after a sum over `tiles` (sort.hpp): a thread writes the pairs of a Gaussian. Pairs beyond the capacity
/// are not written. Errors: device_failed.
struct DuplicateArguments {
  std::uint32_t n;
  ViewParameters view;
  math::Extent extent;
  const ScreenSplat* splats;
  const void* covers;
  const std::uint64_t* pair_end;  ///< [n] inclusive sums of tiles
  PairArrays pairs;
};
Status launch_duplicate(const DuplicateArguments& arguments, Stream stream);

}  // namespace rgs::cuda
