// scene_file.hpp - a scene from an .rgs or a 3DGS PLY file, ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "rgs/camera.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs {

struct SceneFile {
  Scene scene;
  std::uint64_t file_bytes = 0;
  SceneBounds bounds;  ///< robust extent: what an .rgs states, or robust_bounds()
  Vec3 up = kWorldUp;  ///< what an .rgs states, or that of 3DGS worlds
};

/// Reads `path`; its first bytes decide what it is. Errors: those of read_ply() and of Scene::load(); for a bad_value
/// of a PLY, Error::found is the index of the Gaussian.
Result<SceneFile> load_scene_file(const std::string& path);

}  // namespace rgs
