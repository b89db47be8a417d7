// audit_encoding.hpp - encodings for HTML pages: SHA-256, URL.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <string>
#include <string_view>

namespace rgs::audit {

/// FIPS 180-4. A page's policy admits a style or script by this hash.
std::array<std::byte, 32> sha256(std::string_view text);

/// "./" and the file's name, every byte but letters, digits and "-._~" as %HH: a link to a file beside the page. `name`
/// is a file name, not a path.
std::string link_to_file(std::string_view name);

}  // namespace rgs::audit
