// file_parts.hpp - files of which only parts are in memory: what of the head is missing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <span>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// The most of the file's beginning that is one part.
std::span<const std::byte> beginning_of(std::span<const FilePart> parts);

/// What header and table of sections need beyond `beginning`; nothing if they are there. Errors: those of a header.
Result<std::optional<FileRange>> missing_head(std::span<const std::byte> beginning);

}  // namespace rgs::detail
