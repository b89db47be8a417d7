// point_codec.hpp - points with integer coordinates as streams of Draco's kd-tree; docs/format/ARCHIVE.md "MEAN".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::detail {

using GridPoint = std::array<std::uint32_t, 3>;

/// Whether this build has Draco (RGS_ENABLE_DRACO), without which nothing is encoded.
bool can_encode_points();

/// A Draco stream of at least one point, in Draco's order. Deterministic. Errors: internal, unavailable (no Draco).
Result<std::vector<std::byte>> encode_points(std::span<const GridPoint> points);

/// Whether the stream's head is that of n points with coordinates of at most `max_bits` bits.
bool legal_point_head(std::span<const std::byte> stream, std::uint32_t n, std::uint32_t max_bits);

/// Fills `points` in the stream's order. Allocates nothing. Safe on untrusted bytes. Errors: corrupt_data at `offset`,
/// the frame's.
Status decode_points(std::span<const std::byte> stream, std::uint64_t offset, std::uint32_t max_bits,
                     std::span<GridPoint> points);

}  // namespace rgs::detail
