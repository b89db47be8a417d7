// value_counts.hpp - stored values at the ends of their range, which the declarations count.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "rgs/layout.hpp"

namespace rgs::detail {

struct ValueCounts {
  std::uint64_t scale_subnormal = 0, scale_zero = 0, opacity_zero = 0, opacity_one = 0;

  /// A row of GEOM.
  void add(const std::uint16_t geometry[8]) {
    for (int k = 4; k < 7; ++k) {
      scale_zero += geometry[k] == 0;
      scale_subnormal += geometry[k] != 0 && geometry[k] < 0x0400;
    }
    opacity_zero += geometry[7] == 0;
    opacity_one += geometry[7] == 0x3C00;
  }
  void add(const ValueCounts& other) {
    scale_subnormal += other.scale_subnormal;
    scale_zero += other.scale_zero;
    opacity_zero += other.opacity_zero;
    opacity_one += other.opacity_one;
  }
  void declare(Declarations& d) const {
    d.n_scale_subnormal = scale_subnormal;
    d.n_scale_zero = scale_zero;
    d.n_opacity_zero = opacity_zero;
    d.n_opacity_one = opacity_one;
  }
};

}  // namespace rgs::detail
