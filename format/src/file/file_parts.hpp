// file_parts.hpp - files of which only parts are in memory: which bytes of the head are missing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <optional>
#include <span>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// The longest prefix of the file that is a single part.
std::span<const std::byte> beginning_of(std::span<const FilePart> parts);

/// What header and section table need besides `beginning`; nothing if they are complete. Errors: those of a header.
Result<std::optional<FileRange>> missing_head(std::span<const std::byte> beginning);

}  // namespace rgs::detail
