// gltf_splats.hpp - binary glTF files with KHR_gaussian_splatting.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// All splat primitives of the default scene, transformed by their nodes. Attributes must be uncompressed, in the file's
/// own binary chunk, and of a type that the extension allows. A far node translation becomes the origin, see transform_splats().
Result<SplatFile> decode_glb(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// One primitive, with COLOR_0 for viewers that show points. options.origin becomes its node's translation; statements
/// for which the extension has no field go into its extras. Errors: limit_exceeded (above 4 GiB).
Result<std::vector<std::byte>> encode_glb(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
