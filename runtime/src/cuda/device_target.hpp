// device_target.hpp - checks a frame's target and turns it into what the kernels write to.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "common/frame.hpp"
#include "rgs/camera.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// bad_argument, naming the rule, unless every output is aligned and every pitch is 0 or an aligned row or more. Needs
/// no device and ignores the surface.
Status validate(const DeviceTarget& target, const Camera& camera);
/// bad_argument unless the target has no surface, or one that holds the camera's image. Errors: also device_failed.
Status validate_surface(const DeviceTarget& target, const Camera& camera);

cuda::PixelArrays arrays_of(const DeviceTarget& target, const Camera& camera);

}  // namespace rgs::detail
