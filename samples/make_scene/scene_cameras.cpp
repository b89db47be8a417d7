// scene_cameras.cpp - see scene_cameras.hpp.
// SPDX-License-Identifier: Apache-2.0
#include "scene_cameras.hpp"

#include <fmt/format.h>

#include <cmath>

namespace rgs::detail {

std::string camera_list_json(std::span<const View> views, int width, int height, const Origin& origin) {
  const double focal = 0.5 * width / std::tan(kPi / 6);
  std::string json = "[\n";
  for (std::size_t k = 0; k < views.size(); ++k) {
    const Vec forward = glm::normalize(views[k].target - views[k].eye),
              right = glm::normalize(glm::cross(forward, kUp));
    const Vec down = glm::cross(forward, right);
    std::string rows;
    const Vec eye = views[k].eye + Vec(origin[0], origin[1], origin[2]);
    const int digits = origin == kNoOrigin ? 9 : 17;
    for (const Vec& axis : {right, down, forward}) {
      rows += fmt::format("[{1:.{0}g}, {2:.{0}g}, {3:.{0}g}, {4:.{0}g}], ", digits, axis.x, axis.y, axis.z,
                          -glm::dot(axis, eye));
    }
    json += fmt::format(
        "  {{\"name\": \"view{}\", \"split\": \"test\", \"width\": {}, \"height\": {}, \"fx\": {:.9g}, \"fy\": {:.9g}, "
        "\"cx\": {:.9g}, \"cy\": {:.9g},\n   \"world_to_camera\": [{}[0, 0, 0, 1]]}}{}\n",
        k, width, height, focal, focal, 0.5 * width, 0.5 * height, rows, k + 1 < views.size() ? "," : "");
  }
  return json + "]\n";
}

}  // namespace rgs::detail
