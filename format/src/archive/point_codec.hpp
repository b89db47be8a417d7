// point_codec.hpp - points with integer coordinates through Draco's kd-tree; docs/ARCHIVE.md "MEAN".
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

/// A Draco stream of the points, at least one, in an order of its own. Deterministic. Errors: internal.
Result<std::vector<std::byte>> encode_points(std::span<const GridPoint> points);

/// Fills `points`, in the stream's order. Safe on untrusted bytes: Draco is called only if the stream begins as
/// encode_points() makes it, with the count of `points` and coordinates of at most `max_bits` bits. Errors: corrupt_data
/// at `offset`, the frame's place in the file.
Status decode_points(std::span<const std::byte> stream, std::uint64_t offset, std::uint32_t max_bits,
                     std::span<GridPoint> points);

}  // namespace rgs::detail
