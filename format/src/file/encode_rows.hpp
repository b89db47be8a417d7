// encode_rows.hpp - encodes Gaussians as rows of MEAN, GEOM and SHI8.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>

#include "rgs/layout.hpp"
#include "rgs/result.hpp"
#include "rgs/splat_cloud.hpp"
#include "rgs/stored_values.hpp"

namespace rgs::detail {

/// Writes the rows of a chunk's Gaussians, with the degree and scale exponent of `header`: means [n * 12], geometry [n
/// * 16], sh [n * sh_bytes(degree)]. Returns the chunk's entry without step_set.
ChunkEntry encode_rows(std::span<const Splat> splats, const Header& header, const ShStepSet& steps, std::byte* means,
                       std::byte* geometry, std::byte* sh, ValueCounts& counts);

/// read_failed: the second pass over the source contradicts the first.
Status source_changed();

}  // namespace rgs::detail
