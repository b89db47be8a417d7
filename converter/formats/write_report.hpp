// write_report.hpp - how a format's value ranges change a scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Counts what writing sound `splats` as `format` clamps.
WriteReport measure_clamping(const SplatView& splats, SplatFormat format);

/// An error if anything was clamped: bad_value, found: how many Gaussians.
Status refuse_clamping(const WriteReport& report);

/// Counts `more` too.
void add_report(WriteReport& report, const WriteReport& more);

}  // namespace rgs::detail
