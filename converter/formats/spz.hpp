// spz.hpp - Niantic's .spz files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Default fractional bits of means; fewer if one is far out.
inline constexpr int kSpzFractionalBits = 12;

/// Formats whose Gaussians are written as SPZ.
constexpr bool holds_spz(SplatFormat format) {
  return format == SplatFormat::spz || format == SplatFormat::spz_glb || format == SplatFormat::tileset;
}

/// As many fractional bits as the farthest mean allows, at most the default: steps are 2^-bits units. Errors: bad_value
/// if no number of bits suffices; the offset is the Gaussian's index.
Result<int> choose_fractional_bits(const SplatView& splats);

/// Whether the bytes begin as an SPZ does; decompresses the start of a gzip stream.
bool is_spz(std::span<const std::byte> bytes);

/// Versions 2 and 3 (one gzip stream) and 4 (a zstd stream per attribute). Gaussians stay in the axes that an extension
/// declares, or else in options.spz_axes. unsupported_feature for extensions of unknown type, unless they are to be
/// skipped. A georeference is applied, unless `placed` is false: see spz_georeference.hpp.
Result<SplatFile> decode_spz(std::span<const std::byte> bytes, const ReadOptions& options, bool placed);
inline Result<SplatFile> decode_placed_spz(std::span<const std::byte> bytes, const ReadOptions& options) {
  return decode_spz(bytes, options, true);
}

/// Version options.spz_version, else bad_argument, with 12 fractional bits, fewer if a mean needs it; SH of degree 1 in
/// 5 bits, above in 4, as the reference encoder's default. Versions differ in compression, and 2 in rotations. One
/// thread per attribute, same bytes for any number of threads; Gaussians keep their order. Version 4 has extensions for an
/// origin and a CRS.
Result<std::vector<std::byte>> encode_spz(const SplatView& splats, const WriteOptions& options);

}  // namespace rgs::detail
