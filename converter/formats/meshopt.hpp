// meshopt.hpp - attribute streams of KHR_meshopt_compression and EXT_meshopt_compression.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::detail {

enum class MeshoptFilter { none, octahedral, quaternion, exponential, colour };
/// "NONE", "OCTAHEDRAL", ...; nullopt for another name.
std::optional<MeshoptFilter> meshopt_filter_of_text(std::string_view text);

/// The `n` elements of `stride` bytes of a stream in version 0 or 1, filtered; the stream bounds n before memory is
/// allocated. `begin`: its offset in the file. Errors: bad_header (a stride that neither codec nor filter has),
/// unsupported_feature (no attributes of version 0 or 1), truncated, bad_value (a channel's mode), trailing_bytes.
Result<std::vector<std::byte>> decode_meshopt(std::span<const std::byte> stream, std::uint64_t n, std::uint64_t stride,
                                              MeshoptFilter filter, std::uint64_t begin);

}  // namespace rgs::detail
