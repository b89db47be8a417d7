// spz_codes.hpp - what the codes of Niantic's .spz mean. web/viewer compiles it too.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "rgs/splat_cloud.hpp"
#include "spz_header.hpp"

namespace rgs::detail {

/// A colour code is 255 (1/2 + this * coefficient).
inline constexpr double kSpzColourScale = 0.15;
/// Of a component of a rotation in 9 bits.
inline constexpr std::uint32_t kSpzMagnitudeMax = 511;

using SpzStreams = std::array<std::span<const std::byte>, kSpzStreams>;

/// x, y and z in a byte each; `rotation`: w, x, y, z.
void decode_spz_rotation_v2(std::span<const std::byte> code, float (&rotation)[4]);

/// Streams of header.sizes() bytes.
SplatCloud decode_spz_streams(const SpzHeader& header, const SpzStreams& in);

}  // namespace rgs::detail
