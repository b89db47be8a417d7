// usd_splats.hpp - OpenUSD: Gaussians as prims of type ParticleField3DGaussianSplat, in a text (.usda) or in a package of
// one (.usdz).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

bool is_usda(std::span<const std::byte> bytes);
/// Whether the bytes are a zip archive with a layer of OpenUSD.
bool is_usdz(std::span<const std::byte> bytes);

inline constexpr const char* kUsdCrate =
    "OpenUSD's binary .usdc is not read: convert it to text (usdcat -o scene.usda)";

/// The Gaussians of all such prims that the stage shows, after their prims' transforms. A far translation becomes the
/// origin, see transform_splats(). Nothing is composed: where that would change these Gaussians it is an error, else
/// SplatFile::unused names it. Errors also: not_gaussian_splats, size_mismatch.
Result<SplatFile> decode_usda(std::span<const std::byte> bytes, const DecodeLimits& limits);
/// The same of the package's first file. Error offsets are in that file.
Result<SplatFile> decode_usdz(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// One prim with up axis Y. options.origin becomes its translation; statements that the schema has no field for go into
/// customLayerData.
Result<std::vector<std::byte>> encode_usda(const SplatView& splats, const WriteOptions& options);
/// The same as the only file of a package. Errors: limit_exceeded (above 4 GiB).
Result<std::vector<std::byte>> encode_usdz(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
