// audit_encoding.hpp - bytes and names in the forms that a page needs them in: base64, SHA-256, URL.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <string>
#include <string_view>

namespace rgs::audit {

std::string base64(std::span<const std::byte> bytes);

/// FIPS 180-4. Browsers let a style or script run by it.
std::array<std::byte, 32> sha256(std::string_view text);

/// "./" and the file's name, every byte but letters, digits and "-._~" as %HH: a link to a file beside the page, whatever
/// the name. `name` is one file's name, not a path.
std::string link_to_file(std::string_view name);

}  // namespace rgs::audit
