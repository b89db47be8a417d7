// ksplat.hpp - .ksplat files of GaussianSplats3D.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// The format has no signature: checks that version, level and counts of the header agree with each other and the size.
bool looks_like_ksplat(std::span<const std::byte> bytes);

/// Compression levels 0 to 2, SH degrees 0 to 3 (the sections' largest; smaller ones are padded with zeros).
Result<SplatFile> decode_ksplat(std::span<const std::byte> bytes, const ReadOptions& options);

/// GaussianSplats3D has no higher harmonics.
inline constexpr int kKsplatShDegree = 2;
/// Bounds of FP16; smaller scales would be 0, which splat-transform takes for exp(-10).
inline constexpr float kMaxKsplatHalf = 65504, kMinKsplatScale = 0x1p-24F;

/// Level 1, one section, Gaussians from bucket to bucket.
Result<std::vector<std::byte>> encode_ksplat(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
