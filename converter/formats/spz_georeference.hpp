// spz_georeference.hpp - Niantic's extension of SPZ that places a scene in a coordinate reference system.
// Source: nianticlabs/spz, pull request 105 (open in September 2026).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "rgs/interchange.hpp"

namespace rgs::detail {

/// Whether an SPZ with these options can hold the origin: version 4, in axes that Adobe's record names, with no mirror
/// between them and those of the CRS. The CRS too if it is a code or PROJJSON.
bool keeps_origin(const WriteOptions& options);
bool keeps_crs(const WriteOptions& options);
/// Both records, or none where there is neither an origin nor a CRS, or they cannot be held.
std::vector<std::byte> georeference_records(const WriteOptions& options);

/// Places a scene whose axes are declared as the record's payload says. Axes that are turned by quarters are kept and
/// stated as those of the CRS; else the Gaussians are transformed to the axes of the CRS, which are undeclared. Returns
/// false, changing nothing, if the payload is invalid.
bool apply_georeference(std::span<const std::byte> payload, SplatFile& file);

}  // namespace rgs::detail
