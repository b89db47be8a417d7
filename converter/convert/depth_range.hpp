// depth_range.hpp - the sort key's depth range for a set of cameras.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "rgs/camera.hpp"
#include "rgs/encode.hpp"
#include "rgs/result.hpp"

namespace rgs {

/// From the near plane, 0.2, to the 99.9 percentile of the depths of those `origin` + `mean` [n, 3] that lie in a
/// camera's image, widened by a tenth. Uses at most 64 cameras and 65536 means, evenly chosen, so the result depends on
/// the means' order but not on threads. Errors: bad_camera (a camera is invalid), bad_argument (no camera sees
/// anything).
Result<DepthRange> depth_range_from_cameras(std::span<const Camera> cameras, std::span<const float> mean,
                                            const Origin& origin = kNoOrigin);

}  // namespace rgs
