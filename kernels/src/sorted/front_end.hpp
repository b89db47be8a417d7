// front_end.hpp - launches from attributes to unsorted (tile, Gaussian) pairs, in one kernel or in three.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "common/attributes.hpp"
#include "common/frame.hpp"
#include "rgs/result.hpp"

namespace rgs::cuda {

/// Where pairs go. Key and value of a pair have the same index; keys are 32 bits wide if v.key.bits() <= 32 and
/// `narrow_keys`, else 64.
struct PairArrays {
  void* keys;                ///< [capacity]
  std::uint32_t* gaussians;  ///< [capacity]
  std::uint64_t capacity;
  bool narrow_keys;
};

/// One fused kernel (the paper, III-A3): projects n Gaussians, writes splats [n] at the numbers of the visible ones and
/// their pairs, and adds to counters.instances and .visible. Pairs beyond the capacity are counted, not written.
/// `block_state` is null, and blocks take their place among the pairs by an atomic addition, in the order in which they
/// happen to run; or it is [fused_blocks(n) + 1], zeroed before, and pairs lie in the order of the Gaussians' numbers on every
/// run (chained scan, Merrill and Garland 2016). Gaussian order[k] has the number k. Errors: device_failed.
struct FusedArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  math::Extent extent;
  ScreenSplat* splats;
  PairArrays pairs;
  Counters* counters;
  std::uint64_t* block_state;
  const std::uint32_t* order = nullptr;  ///< [n] a permutation; null: Gaussians have their index
};
Status launch_fused(const FusedArguments& arguments, Stream stream);
std::uint32_t fused_blocks(std::uint32_t n);

/// The original's kernels. First: projects n Gaussians, writes splats [n], covers [n] and tiles touched [n], 0 where
/// nothing is drawn, all by the Gaussians' numbers: Gaussian order[k] has the number k. Errors: device_failed.
struct ProjectArguments {
  Attributes attributes;
  std::uint32_t n;
  ViewParameters view;
  math::Extent extent;
  ScreenSplat* splats;
  void* covers;                          ///< [n] of cover_bytes()
  std::uint32_t* tiles;                  ///< [n]
  Counters* counters;                    ///< .visible
  const std::uint32_t* order = nullptr;  ///< [n] a permutation; null: Gaussians have their index
};
Status launch_project(const ProjectArguments& arguments, Stream stream);
std::uint64_t cover_bytes();

/// Third, after a sum over `tiles` (sort.hpp): a thread writes the pairs of a Gaussian. Pairs beyond the capacity are not
/// written. Errors: device_failed.
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
