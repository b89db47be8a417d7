// scene_list.hpp - the scenes below a folder, and what their outputs are called.
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
  SplatFormat format = SplatFormat::unknown;  ///< by content; unknown: only its name says that it is a scene
  std::uint64_t bytes = 0;                    ///< of a SOG's meta.json with the pictures beside it
  Status readable;                            ///< why a scene, or a folder below, cannot be looked at
};

struct SceneList {
  std::vector<ListedScene> scenes;   ///< by name, bytewise
  std::uint64_t n_others = 0;        ///< files that are no scenes
  std::vector<std::string> refused;  ///< links to folders that contain them, relative to the folder
};

/// Lists the scenes of every format below `folder`. A file is a scene if its content says so or, where the content says
/// nothing (damaged, empty, unreadable), its name. Links to files and folders are followed. Left out: folders that begin
/// with a dot and, unless `hidden`, such files; unfinished outputs (NAME.tmp-XXXXXX), whatever is no regular file, and the
/// folders `without`. Errors: open_failed if `folder` itself cannot be read; what cannot be read below it is in the list.
Result<SceneList> list_scenes(const std::string& folder, const std::vector<std::string>& without = {},
                              bool hidden = false);

/// The files of a scene: of a SOG's meta.json also the pictures beside it.
std::vector<std::string> files_of_scene(const std::string& path);

/// "a/b" of "a/b.ply" and "a/b.compressed.ply". An ending that no format has stays: "a/b.v2" is whole.
std::string scene_stem(const std::string& name);

}  // namespace rgs::tool
