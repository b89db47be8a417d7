// tileset_files.hpp - names the files that a tileset of 3D Tiles is read from.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "rgs/api.hpp"

namespace RGS_API rgs {

/// The files that reading a tileset opens beside it, sorted: contents, external tilesets, subtrees and buffers. Of a
/// damaged tileset those before the damage, of other files none. For callers that must not replace or read them.
std::vector<std::string> files_of_tileset(const std::string& path);

}  // namespace rgs
