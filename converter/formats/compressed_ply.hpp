// compressed_ply.hpp - PlayCanvas's compressed PLY files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Log-scales are clamped to +- this; readers treat larger bounds as damage.
inline constexpr double kMaxCompressedLogScale = 20;

/// Whether a PLY header declares packed_position.
bool is_compressed_ply(std::span<const std::byte> bytes);

/// With 18 (chunk colours) or 12 chunk properties, with or without SH, as PlayCanvas's tools and gsplat write it.
Result<SplatFile> decode_compressed_ply(std::span<const std::byte> bytes, const ReadOptions& options);

/// Comments state what options declare. Chunks hold 256 Gaussians that are close in space, or consecutive ones if
/// options.keep_order.
Result<std::vector<std::byte>> encode_compressed_ply(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
