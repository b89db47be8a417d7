// scene_file.hpp - a scene from a splat file of any format, ready to be rendered.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "rgs/camera.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"
#include "rgs/scene.hpp"

namespace rgs {

struct SceneFile {
  SplatFormat format = SplatFormat::unknown;
  Scene scene;
  std::uint64_t file_bytes = 0;  ///< of a SOG folder, of all its files
  SceneBounds bounds;            ///< robust extent: what an .rgs states, or robust_bounds()
  glm::dvec3 up = kWorldUp;      ///< what an .rgs states, or that of 3DGS worlds
};

/// What a file of any format says of itself, for Scene::load(); all else as in the original 3DGS code.
Declarations declarations_of(const SplatFile& file);

/// Reads `path`; its first bytes decide what it is. Scenes of other formats than .rgs are turned into `axes`, those of
/// 3DGS if these are undeclared. Errors: those of read_splats() and of Scene::load(); for a bad_value of the latter, Error::found is the index
/// of the Gaussian.
Result<SceneFile> load_scene_file(const std::string& path, const DecodeLimits& limits = {},
                                  const Axes& axes = kAxes3dgs);
/// The same, but that an .rgs file is opened as by Scene::open(): what draws it first validates it.
Result<SceneFile> open_scene_file(const std::string& path, const DecodeLimits& limits = {});

}  // namespace rgs
