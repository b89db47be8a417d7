// tileset.hpp - 3D Tiles 1.0 and 1.1: a tree of tiles whose contents are glTF files with splats.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"

namespace rgs::detail {

/// A tileset.json, by a key.
bool is_tileset(std::span<const std::byte> bytes);

/// A tileset.json (`bytes`) with its contents and external tilesets below `folder`: of tiles that replace each other the
/// finest, or those ReadOptions::level_of_detail above them, and all that add to each other. A tile's level is that of
/// its highest child plus 1, so that a shorter branch ends with a finer one. Contents without splats replace none.
/// Error offsets are in the tileset or in the content.
/// Errors: those of decode_gltf(); those of Subtree::open(); unsupported_feature (content that is named twice, required
/// extensions, paths outside the folder); limit_exceeded (more than a million tiles).
Result<SplatFile> decode_tileset_folder(std::span<const std::byte> bytes, const std::string& folder,
                                        const ReadOptions& options);
/// open_levels(): a node for each tile with Gaussians. Tiles that add to one are below it, beside a node that repeats
/// its Gaussians. All pieces have the file's origin. Its error is a 16th of geometricError, if that falls downwards.
Result<LevelTree> open_tileset_levels(std::span<const std::byte> bytes, const std::string& folder,
                                      const ReadOptions& options);
/// The paths below `folder` that reading opens, sorted; of a damaged tileset those before the damage. The buffers of a
/// .gltf need not be there.
std::vector<std::string> opened_by_tileset(std::span<const std::byte> bytes, const std::string& folder);
/// Refuses it: its contents are files beside it.
Result<SplatFile> decode_lone_tileset(std::span<const std::byte> bytes, const ReadOptions& options);

}  // namespace rgs::detail
