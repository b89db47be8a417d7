// spatial_order.hpp - Morton order of points.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "rgs/layout.hpp"

namespace rgs {

/// 63-bit Morton key of a point: 21 bits an axis, x lowest. Each axis is mapped linearly inside `robust` and contracted
/// outside it (t -> 1 - 1/(2t) beyond half-width 1), so that a distant background does not coarsen the scene.
class MortonKey {
 public:
  explicit MortonKey(const Box& robust);
  std::uint64_t operator()(const float point[3]) const;

 private:
  double centre_[3], inverse_half_width_[3];
};

/// Sorts `indices` by `keys` (same length), stable, in place; `keys` end up sorted too.
/// Scratch memory: 12 bytes an element.
void sort_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices);

}  // namespace rgs
