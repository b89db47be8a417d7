// spatial_order.cpp - Morton keys (Morton 1966) and sorting by them.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/spatial_order.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>

namespace rgs {
namespace {

// Spreads the low 21 bits with two zero bits after each.
std::uint64_t spread(std::uint64_t x) {
  x &= 0x1FFFFF;
  x = (x | x << 32) & 0x001F00000000FFFF;
  x = (x | x << 16) & 0x001F0000FF0000FF;
  x = (x | x << 8) & 0x100F00F00F00F00F;
  x = (x | x << 4) & 0x10C30C30C30C30C3;
  x = (x | x << 2) & 0x1249249249249249;
  return x;
}

struct Element {
  std::uint64_t key;
  std::uint32_t position;  // makes the order total
  std::uint32_t index;
};

// Puts cells of sorted elements, whose keys agree above their last `bits` bits, back into the order in which they came:
// equal depths are drawn in the order of the file, and the more of it is the source's, the more of the picture is.
void keep_order_in_cells(std::span<Element> elements, int bits) {
  constexpr std::size_t kMostInCell = 1024;
  if (bits == 0 || elements.size() < 2) return;
  if (bits <= 63 - kCellKeyBits && elements.size() <= kMostInCell) {
    std::ranges::sort(elements, {}, &Element::position);
    return;
  }
  const std::uint64_t next = std::uint64_t{1} << (bits - 1);
  const auto upper = std::ranges::partition_point(elements, [next](const Element& e) { return (e.key & next) == 0; });
  keep_order_in_cells({elements.begin(), upper}, bits - 1);
  keep_order_in_cells({upper, elements.end()}, bits - 1);
}

}  // namespace

MortonKey::MortonKey(const Box& robust) {
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const double low = robust.min[axis], high = robust.max[axis];
    centre_[axis] = 0.5 * (low + high);
    inverse_half_width_[axis] = high > low ? 2.0 / (high - low) : 1.0;
  }
}

std::uint64_t MortonKey::operator()(const float point[3]) const {
  std::uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double t = (static_cast<double>(point[axis]) - centre_[axis]) * inverse_half_width_[axis];
    const double size = std::abs(t);
    const double contracted = size <= 1.0 ? 0.5 * size : 1.0 - 0.5 / size;  // [0, 1)
    const double unit = t < 0 ? 0.5 - 0.5 * contracted : 0.5 + 0.5 * contracted;
    const auto cell = std::min(static_cast<std::uint64_t>(unit * 2097152.0), std::uint64_t{2097151});
    key |= spread(cell) << axis;
  }
  return key;
}

std::vector<std::size_t> partition_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices) {
  assert(keys.size() == indices.size());
  // 13 bits, 12 of them of a Morton key's 63: buckets of a million points fit the first-level cache, and the write
  // streams its second-level TLB.
  constexpr int kBits = 13;
  constexpr int kShift = 64 - kBits;
  const std::size_t n = keys.size();
  std::vector<std::size_t> starts((std::size_t{1} << kBits) + 1);
  for (const std::uint64_t key : keys) ++starts[(key >> kShift) + 1];
  for (std::size_t b = 1; b < starts.size(); ++b) starts[b] += starts[b - 1];
  std::vector<std::size_t> next(starts.begin(), starts.end() - 1);
  std::vector<std::uint64_t> other_keys(n);
  std::vector<std::uint32_t> other_indices(n);
  for (std::size_t i = 0; i < n; ++i) {
    const std::size_t to = next[keys[i] >> kShift]++;
    other_keys[to] = keys[i];
    other_indices[to] = indices[i];
  }
  std::ranges::copy(other_keys, keys.begin());
  std::ranges::copy(other_indices, indices.begin());
  return starts;
}

void sort_bucket(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices) {
  std::vector<Element> elements(keys.size());
  for (std::size_t i = 0; i < keys.size(); ++i) elements[i] = {keys[i], static_cast<std::uint32_t>(i), indices[i]};
  std::ranges::sort(elements, [](const Element& a, const Element& b) {
    return a.key != b.key ? a.key < b.key : a.position < b.position;
  });
  keep_order_in_cells(elements, 63);
  for (std::size_t i = 0; i < keys.size(); ++i) {
    keys[i] = elements[i].key;
    indices[i] = elements[i].index;
  }
}

void sort_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices) {
  const std::vector<std::size_t> starts = partition_by_key(keys, indices);
  for (std::size_t b = 0; b + 1 < starts.size(); ++b) {
    const std::size_t count = starts[b + 1] - starts[b];
    if (count > 1) sort_bucket(keys.subspan(starts[b], count), indices.subspan(starts[b], count));
  }
}

}  // namespace rgs
