// gltf_splats.hpp - binary glTF files with KHR_gaussian_splatting.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"
#include "stated_scene.hpp"

namespace rgs::detail {

/// All splat primitives of the default scene, moved by their nodes. Attributes must be uncompressed 32-bit floats in
/// the file's own binary chunk. A node's translation that is far becomes the origin, see transform_splats().
Result<SplatFile> decode_glb(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// One primitive, with COLOR_0 for viewers that show points; stated.origin is its node's translation, what else the
/// extension has no place for is in its extras. Errors: limit_exceeded (above 4 GiB).
Result<std::vector<std::byte>> encode_glb(const SplatView& splats, const StatedScene& stated);

}  // namespace rgs::detail
