// audit_scenes.hpp - the scenes that an audit renders: source, asset, and mixtures of both.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "audit_pairing.hpp"
#include "audit_source.hpp"
#include "rgs/decode.hpp"
#include "rgs/scene.hpp"
#include "scene_file.hpp"

namespace rgs::audit {

/// The source for drawing: damaged Gaussians are repaired as by repair(), or dropped and counted.
struct SourceScene {
  Scene scene;
  SceneBounds bounds;
  std::uint64_t n_left_out = 0;
};
Result<SourceScene> source_scene(const Source& source);

/// The sources of a mixture's attributes. Its Gaussians are the asset's, in the asset's order.
enum class Mixture : std::uint8_t {
  source,           ///< all of the source
  stored_sh,        ///< SH of the asset, the rest of the source
  stored_geometry,  ///< means, rotations, scales and opacities of the asset, SH of the source
  file_scales,      ///< SH of the source quantised with one step set for the file, the rest of the source
  chunk_step_sets,  ///< the same with one set per chunk of 256
};
/// Requires that every Gaussian of the asset is paired; else bad_argument.
Result<Scene> mixed_scene(const Source& source, const FileView& asset, const Pairing& pairing, Mixture mixture);

}  // namespace rgs::audit
