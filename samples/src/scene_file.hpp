// scene_file.hpp - a scene from an .rgs or a 3DGS PLY file, ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "rgs/camera.hpp"
#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs {

struct SceneFile {
  Scene scene;
  std::uint64_t file_bytes = 0;
  std::optional<Declarations> declarations;  ///< what an .rgs states about itself; a PLY states nothing
  SceneBounds bounds;                        ///< robust extent: the stated one, or robust_bounds()
  Vec3 up = kWorldUp;                        ///< the stated up direction, or that of 3DGS worlds
};

/// Reads `path`; its first bytes decide what it is. Errors: those of rgs::open and rgs::validate, of read_ply, and of
/// Scene::load.
Result<SceneFile> load_scene_file(const std::string& path);

}  // namespace rgs
