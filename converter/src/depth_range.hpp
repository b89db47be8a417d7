// depth_range.hpp - the sort key's depth range as a set of cameras sees the scene.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "rgs/camera.hpp"
#include "rgs/encode.hpp"
#include "rgs/result.hpp"

namespace rgs {

/// The 0.1 and 99.9 percentiles of the depths of those `mean` [n, 3] that lie in a camera's image, widened by a tenth
/// at the near end (not below the near plane, 0.2) and at the far end. At most 64 cameras and 65536 means are looked
/// at, evenly chosen, so the result depends on the means' order but not on threads. Errors: bad_camera (a camera is
/// invalid), bad_argument (no camera sees anything).
Result<DepthRange> depth_range_from_cameras(std::span<const Camera> cameras, std::span<const float> mean);

}  // namespace rgs
