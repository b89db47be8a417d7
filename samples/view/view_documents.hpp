// view_documents.hpp - writes view.json and cameras.json for the page: docs/user/VIEW.md.
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

/// `name` for use in an address: everything but letters, digits, '-', '.', '_' and '~' as %XX.
std::string percent_encoded(std::string_view name);

/// The cameras as in 3DGS' cameras.json, with the principal point: [{id, img_name, width, height, position, rotation, fx, fy, cx, cy}].
/// parse_camera_json() reads them.
std::string cameras_json(std::span<const Camera> cameras);

/// The part of the page's address behind #, so that it starts at `camera`; two scenes start with the slider. The pivot is the point ahead
/// of the camera that is nearest to the middle of all cameras.
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
  std::string cameras = {};  ///< address, empty without cameras
  std::vector<Photo> photos = {};
  std::string backend = {};  ///< of frames, "cpu" or "cuda"; empty without frames
  bool spz_opengl = false;   ///< the axes of SPZ files that declare none: right, up, backward
};

/// Bytes of names that are not UTF-8 become replacement characters.
std::string view_json(const ViewDocument& document);

}  // namespace rgs::view
