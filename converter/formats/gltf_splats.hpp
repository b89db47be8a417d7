// gltf_splats.hpp - glTF files with KHR_gaussian_splatting.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// A .glb, or a .gltf by one of its keys.
bool is_gltf(std::span<const std::byte> bytes);
bool is_gltf_text(std::span<const std::byte> bytes);

/// All splat primitives of the default scene of a .glb, or of a .gltf whose buffers are data: URIs, transformed by their
/// nodes. Attributes are of a type that the extension allows, or a primitive is an SPZ. A far node translation becomes the
/// origin, see transform_splats().
Result<SplatFile> decode_gltf(std::span<const std::byte> bytes, const ReadOptions& options);
/// A .gltf (`bytes`) with its buffers in `folder`. Offsets of errors are in the .gltf or in a buffer.
Result<SplatFile> decode_gltf_folder(std::span<const std::byte> bytes, const std::string& folder,
                                     const ReadOptions& options);

/// One primitive, with COLOR_0 for viewers that show points. options.origin becomes its node's translation; statements
/// for which the extension has no field go into its extras. Errors: limit_exceeded (above 4 GiB).
Result<std::vector<std::byte>> encode_glb(const SplatView& splats, const WriteOptions& options);

/// A .glb that names one of the extensions for SPZ.
bool is_spz_glb(std::span<const std::byte> bytes);
/// The same with its Gaussians in an SPZ, as encode_spz() writes it, in the axes of glTF.
Result<std::vector<std::byte>> encode_spz_glb(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
