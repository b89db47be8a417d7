// bench_plot.hpp - a report's roofline as a picture.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench_report.hpp"

namespace rgs::bench {

/// SVG: for each size the roofs with a point for each stage that computes in FP32, and beside them floor / time of all
/// stages as bars. Modes are drawn, the steps between them are not. report.rates is there.
std::string roofline_svg(const Report& report);

}  // namespace rgs::bench
