// render_options.hpp - checks that both renderers make before a frame.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/camera.hpp"
#include "rgs/math/camera.hpp"
#include "rgs/renderer.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// bad_argument, naming the option that has no such value.
Status validate(const RenderOptions& options);
/// bad_argument unless every span is empty or has the camera's pixels.
Status validate(const RenderTarget& target, const Camera& camera);

math::View<float> make_view(const Camera& camera, const RenderOptions& options);

}  // namespace rgs::detail
