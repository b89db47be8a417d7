// npz.hpp - NumPy's .npz of a scene: the parameters of gsplat as arrays.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Whether the bytes are a zip archive of .npy files.
bool is_npz(std::span<const std::byte> bytes);

/// Arrays means [n, 3], scales [n, 3] (log), quats [n, 4] (w, x, y, z), opacities [n] or [n, 1] (logit), sh0 [n, 1, 3]
/// or [n, 3], shN [n, k, 3] with k = 0, 3, 8 or 15, or none; float16, 32 or 64, little-endian. Others are ignored. Means
/// that FP32 cannot hold get an origin. Error offsets are in the array's .npy.
Result<SplatFile> decode_npz(std::span<const std::byte> bytes, const DecodeLimits& limits);

/// The same arrays as float32, stored without compression; means as float64 if options have an origin.
Result<std::vector<std::byte>> encode_npz(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
