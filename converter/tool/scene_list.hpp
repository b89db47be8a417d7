// scene_list.hpp - lists the scenes below a folder, and names their outputs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs::tool {

struct ListedScene {
  std::string name;  ///< relative to the folder
  std::string path;
  SplatFormat format = SplatFormat::unknown;  ///< by content; unknown: only the name indicates a scene
  std::uint64_t bytes = 0;                    ///< of a SOG's meta.json and a lod-meta.json including their files
  Status readable;                            ///< the error if a scene, or a folder below, cannot be read
};

struct SceneList {
  std::vector<ListedScene> scenes;   ///< by name, bytewise
  std::uint64_t n_others = 0;        ///< files that are no scenes
  std::vector<std::string> refused;  ///< links to folders that contain them, relative to the folder
};

/// Lists the scenes of every format below `folder`. A file is a scene by its content or, if that says nothing (damaged,
/// empty, unreadable), by its name. Links to files and folders are followed. Skipped: folders that begin with a dot
/// and, unless `hidden`, such files; unfinished outputs (NAME.tmp-XXXXXX); what is not a regular file; and the folders
/// `without`.
/// Errors: open_failed if `folder` itself cannot be read; unreadable entries below it are in the list.
Result<SceneList> list_scenes(const std::string& folder, const std::vector<std::string>& without = {},
                              bool hidden = false);

/// The files of a scene: InputFiles::add_scene().
std::vector<std::string> files_of_scene(const std::string& path);

/// "a/b" for "a/b.ply" and "a/b.compressed.ply". Unknown endings stay: "a/b.v2" is a whole stem.
std::string scene_stem(const std::string& name);

}  // namespace rgs::tool
