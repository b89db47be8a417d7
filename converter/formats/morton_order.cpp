// morton_order.cpp - Gaussians along a Morton curve.
// SPDX-License-Identifier: Apache-2.0
#include "morton_order.hpp"

#include <algorithm>
#include <utility>

#include "rgs/scene_scan.hpp"
#include "rgs/spatial_order.hpp"

namespace rgs::detail {

std::vector<std::uint32_t> morton_order(const SplatView& splats) {
  SceneScan scan(splats.sh_degree);
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    Splat splat = splats.splat(i);
    scan.add(splat);
  }
  const MortonKey key(scan.robust());
  std::vector<std::pair<std::uint64_t, std::uint32_t>> keys(splats.n);
  for (std::uint32_t i = 0; i < keys.size(); ++i) keys[i] = {key(&splats.mean[3 * std::size_t{i}]), i};
  std::ranges::sort(keys);
  std::vector<std::uint32_t> order(splats.n);
  std::ranges::transform(keys, order.begin(), &std::pair<std::uint64_t, std::uint32_t>::second);
  return order;
}

}  // namespace rgs::detail
