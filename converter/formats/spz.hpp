// spz.hpp - Niantic's .spz files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// A colour code is 255 (1/2 + this * coefficient).
inline constexpr double kSpzColourScale = 0.15;
/// Fractional bits of means, unless one is too far out.
inline constexpr int kSpzFractionalBits = 12;

/// As many fractional bits as the farthest mean leaves, at most the usual ones: steps are of
/// 2^-bits units. Errors: bad_value if there is no room at
/// all; the offset is the Gaussian's index.
Result<int> choose_fractional_bits(const SplatView& splats);

/// Whether the bytes begin as an SPZ does; a gzip stream is unpacked far enough to see its signature.
bool is_spz(std::span<const std::byte> bytes);

/// Versions 2 and 3 (one gzip stream) and 4 (zstd streams by attribute). Gaussians stay in kAxesOpenGl, or in the axes
/// that an extension declares. unsupported_feature for extensions of unknown type, unless they are to be skipped.
Result<SplatFile> decode_spz(std::span<const std::byte> bytes, const DecodeLimits& limits,
                             bool skip_unknown_extensions);

/// `version` 2, 3 or 4, with 12 fractional bits, fewer if a mean needs it; SH of degree 1 in 5 bits, above in 4, as the
/// reference encoder's default. Versions differ in compression, and 2 in rotations. One thread for each attribute, the
/// same bytes however many run; Gaussians keep their order.
Result<std::vector<std::byte>> encode_spz(const SplatView& splats, AaMode aa_mode, int version);

}  // namespace rgs::detail
