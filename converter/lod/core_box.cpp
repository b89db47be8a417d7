// core_box.cpp - the box of means that holds most of what is visible.
// SPDX-License-Identifier: Apache-2.0
//
// Floaters and Gaussians of the sky would make a page seem near. The little of it that is nearer than its core is drawn
// as coarsely as the rest. docs/develop/LEVELS.md, "Error".
#include "core_box.hpp"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

namespace rgs::lod {

Box core_of(const SplatView& splats, std::uint64_t first, std::uint64_t n) {
  std::vector<double> covered(n);
  double total = 0;
  for (std::uint64_t i = 0; i < n; ++i) {
    const float* const log_scale = &splats.log_scale[3 * (first + i)];
    double side[3];
    for (int k = 0; k < 3; ++k) side[k] = std::exp(static_cast<double>(log_scale[k]));
    const double areas = side[0] * side[1] + side[1] * side[2] + side[2] * side[0];
    covered[i] = areas / (1 + std::exp(-static_cast<double>(splats.opacity_logit[first + i])));
    total += covered[i];
  }
  Box box;
  std::vector<std::pair<float, std::uint32_t>> along(n);
  for (std::size_t k = 0; k < 3; ++k) {
    for (std::uint64_t i = 0; i < n; ++i) along[i] = {splats.mean[3 * (first + i) + k], static_cast<std::uint32_t>(i)};
    std::sort(along.begin(), along.end());
    // Moves inwards from one end, as long as little enough lies outside.
    const auto end_of_core = [&](auto from, auto last) {
      for (double outside = covered[from->second]; from != last && outside <= kOutsideCore * total; ++from) {
        outside += covered[std::next(from)->second];
      }
      return from->first;
    };
    box.min[k] = end_of_core(along.begin(), std::prev(along.end()));
    box.max[k] = std::max(box.min[k], end_of_core(along.rbegin(), std::prev(along.rend())));
  }
  return box;
}

}  // namespace rgs::lod
