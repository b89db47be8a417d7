// frame_settings.hpp - the choices of a frame that the pipelines read.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/renderer.hpp"

namespace rgs::detail {

using FrameSettings = RenderOptions;

}  // namespace rgs::detail
