// origin_of.hpp - the origin of scenes whose positions come as FP64.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "rgs/layout.hpp"

namespace rgs::detail {

/// An origin near the middle of `n` positions, where position(i) is a std::array of three doubles; kNoOrigin if FP32
/// holds them all. Percentiles, because the few far outliers of every trained scene would stretch a full box, and with
/// it the rounding, beyond the scene.
template <class Position>
Origin origin_of(std::uint64_t n, const Position& position) {
  const auto is_float = [](double x) {
    return !(static_cast<double>(static_cast<float>(x)) != x) || !std::isfinite(x);
  };
  std::uint64_t exact = 0;
  while (exact < n && std::ranges::all_of(position(exact), is_float)) ++exact;
  if (exact == n) return kNoOrigin;

  constexpr std::uint64_t kSampled = 65536;
  const std::uint64_t n_sampled = std::min(n, kSampled);
  std::array<std::vector<double>, 3> sample;
  for (std::uint64_t k = 0; k < n_sampled; ++k) {
    const auto x = position(k * n / n_sampled);
    if (!std::ranges::all_of(x, [](double v) { return std::fabs(v) <= 2 * kMaxOrigin; })) continue;
    for (std::size_t axis = 0; axis < 3; ++axis) sample[axis].push_back(x[axis]);
  }
  if (sample[0].empty()) return kNoOrigin;
  std::array<double, 3> middle;
  double size = 0;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    std::ranges::sort(sample[axis]);
    const std::size_t cut = sample[axis].size() / 50;
    const double low = sample[axis][cut], high = sample[axis][sample[axis].size() - 1 - cut];
    middle[axis] = 0.5 * (low + high);
    size = std::max(size, high - low);
  }
  int exponent = 0;
  std::frexp(size, &exponent);
  const double unit = size > 0 ? std::ldexp(1.0, exponent) : 1;
  Origin chosen;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    chosen[axis] = std::nearbyint(middle[axis] / unit) * unit + 0.0;
    if (!(std::fabs(chosen[axis]) <= kMaxOrigin)) return kNoOrigin;
  }
  return chosen;
}

}  // namespace rgs::detail
