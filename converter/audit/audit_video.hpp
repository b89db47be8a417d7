// audit_video.hpp - the frames of a video together.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "audit.hpp"

namespace rgs::audit {

/// `frames` in their order, at least one of them rated. The worst second is the worst of all runs of `fps` frames, of
/// all frames if there are fewer.
VideoReport video_report(std::span<const ViewResult> frames, int fps);

}  // namespace rgs::audit
