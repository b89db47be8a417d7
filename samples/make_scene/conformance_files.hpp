// conformance_files.hpp - writes the micro-scenes with their reference pictures into a folder.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "rgs/file.hpp"

namespace rgs {

/// Writes conformance.json, README.md, LICENSE and, for each scene, NAME/scene.ply, NAME/cameras.json and a reference
/// NAME/CAMERA.exr for each camera, drawn from the PLY by the scalar definition on the CPU. The same bytes every time.
/// A folder that is not empty is refused without `options.overwrite`. Reports errors itself and returns the exit code.
int write_conformance(const std::string& folder, const AtomicFile::Options& options, bool quiet);

}  // namespace rgs
