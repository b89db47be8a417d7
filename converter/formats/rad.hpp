// rad.hpp - .rad of Spark (three.js): chunks of Gaussians, all levels of detail in one tree.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "rgs/interchange.hpp"
#include "rgs/level_tree.hpp"

namespace rgs::detail {

inline constexpr std::string_view kRadMagic = "RAD0", kRadChunkMagic = "RADC";
inline constexpr std::uint64_t kRadChunk = 65536;  ///< Gaussians; Spark's pages hold as many
/// Bounds of what is written; a scene's own are used where they are narrower. Spark's are the same or a little wider.
inline constexpr float kMinRadLogScale = -12, kMaxRadLogScale = 9, kMinRadColour = -1, kMaxRadColour = 2, kMaxRadSh = 1;

bool is_rad(std::span<const std::byte> bytes);

/// The leaves of the tree, or a cut through it: ReadOptions::level_of_detail. Error offsets are in the file.
Result<SplatFile> decode_rad(std::span<const std::byte> bytes, const ReadOptions& options);
/// The same, of which chunks may be .radc files in `folder`. Error offsets in a chunk are in its own file.
Result<SplatFile> decode_rad_folder(std::span<const std::byte> bytes, const std::string& folder,
                                    const ReadOptions& options);
/// open_levels(), without nodes if there is no tree. An empty `folder` holds no .radc files.
Result<LevelTree> open_rad_levels(std::span<const std::byte> bytes, const std::string& folder,
                                  const ReadOptions& options);

/// A unit quaternion x, y, z, w with w >= 0 as its axis on an octahedron and its angle.
std::array<float, 4> decode_octahedral(const std::array<std::uint8_t, 3>& code);

/// Children of each Gaussian, a run of later ones; the first Gaussian is the root.
struct RadTree {
  std::vector<std::uint16_t> n_children;
  std::vector<std::uint32_t> first_child;
};
/// Sound Gaussians in their order, with a tree if there is one. Deterministic.
std::vector<std::byte> encode_rad_chunks(const SplatView& splats, const RadTree* tree, unsigned threads);
Result<std::vector<std::byte>> encode_rad(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
