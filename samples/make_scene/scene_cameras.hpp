// scene_cameras.hpp - the cameras of synthetic scenes as the project's JSON list (docs/user/CAMERAS.md).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "rgs/splat_cloud.hpp"
#include "scene_math.hpp"

namespace rgs::detail {

/// A camera without roll at `eye`, metres in the scene's frame, that looks at `target`, not straight up or down.
struct View {
  Vec eye, target;
};

/// The views as a JSON list, horizontal field of view 60 degrees, all of them test cameras: "view0", "view1", ...
std::string camera_list_json(std::span<const View> views, int width, int height, const Origin& origin);

}  // namespace rgs::detail
