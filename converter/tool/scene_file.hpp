// scene_file.hpp - loads a scene from a splat file of any format, ready to render.
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
  glm::dvec3 up = kWorldUp;      ///< the .rgs's, or that of 3DGS
};

/// The file's declarations, for Scene::load(); those of the original 3DGS code where it states none.
Declarations declarations_of(const SplatFile& file);

/// Reads `path`; the content decides the format. Of `options` limits and SPZ's axes count. Scenes of formats other than
/// .rgs are converted to `axes`, or to those of 3DGS if undeclared. Errors: those of read_splats() and Scene::load(); for a bad_value of the latter, Error::found
/// is the Gaussian's index.
Result<SceneFile> load_scene_file(const std::string& path, const ReadOptions& options = {},
                                  const Axes& axes = kAxes3dgs);
/// The same, but opens an .rgs file by Scene::open(): drawing validates it.
Result<SceneFile> open_scene_file(const std::string& path, const ReadOptions& options = {});

}  // namespace rgs
