// spatial_order.hpp - Morton order of points.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/layout.hpp"

namespace RGS_API rgs {

/// 63-bit Morton key of a point: 21 bits an axis, x lowest. Each axis is linear inside `robust` and contracted outside
/// (t -> 1 - 1/(2t) beyond half-width 1), so that a distant background does not coarsen the scene.
class MortonKey {
 public:
  explicit MortonKey(const Box& robust);
  std::uint64_t operator()(const float point[3]) const;

 private:
  double centre_[3], inverse_half_width_[3];
};

/// Sorts `indices` and `keys` (same length) along the curve, in place: by key, but those of one cell (FORMAT.md,
/// "Morton order") keep their order. Scratch memory: 12 bytes an element, 16 if most keys are alike.
void sort_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices);

/// Upper bits of a key that agree within a cell: where they change, the curve may be cut and its parts sorted each on
/// its own.
inline constexpr int kCellKeyBits = 24;

/// The two steps of sort_by_key, for several threads. partition_by_key moves elements into buckets by the keys' upper
/// bits, stable, and returns where each bucket starts, then the end; each bucket is then sorted on its own, on any
/// thread.
std::vector<std::size_t> partition_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices);
void sort_bucket(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices);

}  // namespace rgs
