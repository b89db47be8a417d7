// point_codec.hpp - points with integer coordinates as streams of Draco's kd-tree; docs/format/ARCHIVE.md "Tree".
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "rgs/result.hpp"

namespace rgs::detail {

using GridPoint = std::array<std::uint32_t, 3>;

/// Fills `points` in the stream's order. Coordinates have at most `max_bits` bits. Allocates nothing. Safe on untrusted
/// bytes. Errors: corrupt_data at `offset`, the frame's.
Status decode_points(std::span<const std::byte> stream, std::uint64_t offset, std::uint32_t max_bits,
                     std::span<GridPoint> points);

}  // namespace rgs::detail
