// camera_choice.hpp - chooses cameras of a file and names their pictures.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include "rgs/camera_file.hpp"

namespace rgs {

/// File name without extension for camera `index` of a list: the last part of the camera's name, harmless characters
/// only.
std::string picture_stem(const Camera& camera, std::size_t index);

/// FOLDER/STEM.KIND.png, camera by camera, of each kind. Where cameras share a stem, later ones get their index too.
std::vector<std::string> picture_paths(const std::string& folder, std::span<const Camera> cameras,
                                       std::span<const char* const> kinds);

/// Cameras of `split` ("train", "test", or "" for both) that match `view`: "all", a camera's name, its picture_stem(),
/// or an index in the split. The error is a message for the user.
tl::expected<std::vector<Camera>, std::string> choose_cameras(const CameraSet& set, const std::string& split,
                                                              const std::string& view);

}  // namespace rgs
