// write_report.hpp - what the ranges of a format do to a scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// What writing `splats`, which are sound, as `format` clamps.
WriteReport measure_clamping(const SplatView& splats, SplatFormat format);

/// An error if anything was clamped. bad_value; found: how many Gaussians.
Status refuse_clamping(const WriteReport& report);

}  // namespace rgs::detail
