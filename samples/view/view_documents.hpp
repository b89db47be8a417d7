// view_documents.hpp - what the page is told: view.json and cameras.json. docs/user/VIEW.md has every field.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/camera.hpp"

namespace rgs::view {

/// `name` as a part of an address: all but letters, digits, '-', '.', '_' and '~' as %XX of its bytes.
std::string percent_encoded(std::string_view name);

/// The cameras as 3DGS training programs write them, with the principal point besides: [{id, img_name, width, height, position, rotation,
/// fx, fy, cx, cy}]. parse_camera_json() gives them back.
std::string cameras_json(std::span<const Camera> cameras);

/// What stands behind the # of the page's address to begin at `camera`; with two scenes, by a slider between them. What is orbited is the point
/// ahead of it that is nearest to the middle of all cameras, which stand around what they look at.
std::string view_link(const Camera& camera, std::span<const Camera> all, bool two_scenes);

struct ViewDocument {
  struct Scene {
    std::string name, url;
    std::uint64_t bytes = 0;
  };
  struct Photo {
    std::string camera, url;
  };
  std::vector<Scene> scenes;
  std::string cameras = {};  ///< its address, empty without cameras
  std::vector<Photo> photos = {};
  std::string backend = {};  ///< that frames come from, "cpu" or "cuda"; empty without them
};

/// The document as JSON. Names that are not UTF-8 get replacement characters.
std::string view_json(const ViewDocument& document);

}  // namespace rgs::view
