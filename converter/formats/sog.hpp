// sog.hpp - PlayCanvas SOG: a scene as a few lossless WebP images and a meta.json.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Any zip archive, or a meta.json, by its first keys.
bool is_sog(std::span<const std::byte> bytes);
bool is_sog_meta(std::span<const std::byte> bytes);

/// A zipped SOG, version 1 or 2. Error offsets are in the image or in meta.json.
Result<SplatFile> decode_sog(std::span<const std::byte> bytes, const ReadOptions& options);
/// meta.json (`bytes`) with its images in `folder`.
Result<SplatFile> decode_sog_folder(std::span<const std::byte> bytes, const std::string& folder,
                                    const ReadOptions& options);

/// Returns the bytes of one of the scene's files by its name.
using FetchFile = std::function<Result<std::vector<std::byte>>(const std::string&)>;
/// Whether a name is that of a file in the scene's folder.
bool is_beside(const std::string& name);
/// Of files in `folder`, whose sizes it adds to `total`. Both must outlive it.
FetchFile fetch_from(const std::string& folder, std::uint64_t& total);
/// meta.json (`bytes`) with images from `fetch`; SplatFile::bytes is the caller's.
Result<SplatFile> decode_sog_files(std::span<const std::byte> bytes, const FetchFile& fetch,
                                   const ReadOptions& options);

/// Harmonics are clamped to +- this when written, so that their squares and sums stay numbers.
inline constexpr float kMaxSogHarmonic = 1e6F;

/// A zipped SOG of version 2 of sound Gaussians, along a Morton curve unless WriteOptions::keep_order. The same bytes
/// for any number of threads. Memory: 0.5 kB a Gaussian. Errors: bad_value (no Gaussians), limit_exceeded (more than
/// an image's pixels).
Result<std::vector<std::byte>> encode_sog(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
