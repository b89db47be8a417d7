// device_target.hpp - whether a frame can be written where the caller wants it, and what the kernels get to write to.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "common/frame.hpp"
#include "rgs/camera.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// bad_argument, naming the rule, unless every output is aligned and every pitch 0 or an aligned row or more. Needs no
/// device: a surface is not looked at.
Status validate(const DeviceTarget& target, const Camera& camera);
/// bad_argument unless the target has no surface, or one that holds the camera's image. Errors: also device_failed.
Status validate_surface(const DeviceTarget& target, const Camera& camera);

cuda::PixelArrays arrays_of(const DeviceTarget& target, const Camera& camera);

}  // namespace rgs::detail
