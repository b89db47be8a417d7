// spatial_order.cpp - Morton keys (Morton 1966) and a least-significant-digit radix sort.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/spatial_order.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <utility>

namespace rgs {
namespace {

// Spreads the low 21 bits so that two zero bits follow each.
std::uint64_t spread(std::uint64_t x) {
  x &= 0x1FFFFF;
  x = (x | x << 32) & 0x001F00000000FFFF;
  x = (x | x << 16) & 0x001F0000FF0000FF;
  x = (x | x << 8) & 0x100F00F00F00F00F;
  x = (x | x << 4) & 0x10C30C30C30C30C3;
  x = (x | x << 2) & 0x1249249249249249;
  return x;
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

void sort_by_key(std::span<std::uint64_t> keys, std::span<std::uint32_t> indices) {
  assert(keys.size() == indices.size());
  const std::size_t n = keys.size();
  // Digits of 8 bits: the 256 write streams stay within the TLB and the first-level cache.
  constexpr int kDigits = 8;
  std::array<std::array<std::size_t, 256>, kDigits> counts{};
  for (const std::uint64_t key : keys) {
    for (int d = 0; d < kDigits; ++d) ++counts[static_cast<std::size_t>(d)][key >> (8 * d) & 255];
  }
  std::vector<std::uint64_t> other_keys(n);
  std::vector<std::uint32_t> other_indices(n);
  std::span<std::uint64_t> k0 = keys, k1 = other_keys;
  std::span<std::uint32_t> i0 = indices, i1 = other_indices;
  for (int d = 0; d < kDigits; ++d) {
    auto& count = counts[static_cast<std::size_t>(d)];
    if (std::ranges::any_of(count, [n](std::size_t c) { return c == n; })) continue;  // all keys share this digit
    std::size_t sum = 0;
    for (std::size_t& c : count) c = std::exchange(sum, sum + c);
    for (std::size_t i = 0; i < n; ++i) {
      const std::size_t to = count[k0[i] >> (8 * d) & 255]++;
      k1[to] = k0[i];
      i1[to] = i0[i];
    }
    std::swap(k0, k1);
    std::swap(i0, i1);
  }
  if (k0.data() != keys.data()) {
    std::ranges::copy(k0, keys.begin());
    std::ranges::copy(i0, indices.begin());
  }
}

}  // namespace rgs
