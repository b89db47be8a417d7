// audit_chart.hpp - charts of a report as inline SVG, in the page's colours.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "audit.hpp"

namespace rgs::audit {

/// Errors on a logarithmic axis in `unit`, with marks at the median, 99 % and the largest. `label` is for screen
/// readers.
std::string error_histogram(const ErrorStatistics& errors, const std::string& unit, const std::string& label);

/// A curve over frames, with a gap where a value is NaN, infinity at the top, and a bar under its worst second of `fps`
/// frames.
std::string frame_curve(const Curve& curve, int fps, const std::string& label);

/// How often each SH code -127 to 127 occurs; height by the logarithm of the count.
std::string code_histogram(const CodeUsage& usage, const std::string& label);

}  // namespace rgs::audit
