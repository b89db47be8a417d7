// streamed_sog.hpp - PlayCanvas streamed SOG: a scene's regions at several levels of detail, in SOGs of many regions.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>

#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"

namespace rgs::detail {

/// A lod-meta.json, by a key, or a zip archive that holds one.
bool is_streamed_sog(std::span<const std::byte> bytes);
bool is_streamed_sog_meta(std::span<const std::byte> bytes);

/// Of each region the level ReadOptions::level_of_detail, by default the finest; where a region lacks it, the next
/// finer one, else the next coarser. In the order of the SOGs that hold them, which are decoded one at a time. Error offsets
/// are as in sog.hpp.
Result<SplatFile> decode_streamed_sog(std::span<const std::byte> bytes, const ReadOptions& options);
/// lod-meta.json (`bytes`) with its SOGs below `folder`.
Result<SplatFile> decode_streamed_sog_folder(std::span<const std::byte> bytes, const std::string& folder,
                                             const ReadOptions& options);
/// open_levels() of either: chains of the levels that each region has.
Result<LevelTree> open_streamed_sog_levels(std::span<const std::byte> bytes, const std::string& folder,
                                           const ReadOptions& options);

}  // namespace rgs::detail
