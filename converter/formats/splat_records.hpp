// splat_records.hpp - .splat files: 32-byte records without a header.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// The format has no signature: checks that the size is a positive multiple of 32 and that the first and last records
/// (up to 256 of each) hold finite means, finite scales >= 0, and half of them rotations near unit length.
bool looks_like_splat_records(std::span<const std::byte> bytes);

/// Errors: truncated (the size is no multiple of 32), limit_exceeded.
Result<SplatFile> decode_splat_records(std::span<const std::byte> bytes, const ReadOptions& options);

/// Harmonics above the constant one are left out.
Result<std::vector<std::byte>> encode_splat_records(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
