// one_scene_only.cpp - replaces many_scenes.cpp and scene_in_parts.cpp where a program cannot fork: Windows.
// SPDX-License-Identifier: Apache-2.0
#include "rgs_convert.hpp"

namespace rgs {

void ManyScenes::add_to(CLI::App&) {}

int ManyScenes::convert(ConvertArguments& arguments) {
  return tool::report_usage(arguments.scene.files.front() +
                            " is a folder; this build converts one scene at a time: call it for each file");
}

void SceneInParts::add_to(CLI::App&) {}

int SceneInParts::convert(const CLI::App&, ConvertArguments&, const std::string&) const {
  return tool::kInternal;
}

}  // namespace rgs
