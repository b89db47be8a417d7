// compressed_ply.hpp - PlayCanvas's compressed PLY files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {

/// Log-scales are written within +- this: readers take a bound beyond that for damage.
inline constexpr double kMaxCompressedLogScale = 20;

/// Whether a PLY header declares packed_position.
bool is_compressed_ply(std::span<const std::byte> bytes);

/// With chunk colours (18 properties) or without (12), with or without SH, as PlayCanvas's tools and gsplat write it.
Result<SplatFile> decode_compressed_ply(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// `stated` in comments. Chunks of 256 Gaussians that lie together, or as they come if `keep_order`.
/// Errors: limit_exceeded (2^32 Gaussians to sort).
Result<std::vector<std::byte>> encode_compressed_ply(const SplatView& splats, const StatedScene& stated,
                                                     bool keep_order);

}  // namespace rgs::detail
