// encoding.hpp - encodings for pages: encoding_openssl.cpp, encoding_windows.cpp.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <string>
#include <string_view>

namespace rgs::tool {

/// RFC 4648, section 4. At most 2^30 bytes.
std::string base64(std::span<const std::byte> bytes);

/// FIPS 180-4. A page's policy admits a style or script by this hash.
std::array<std::byte, 32> sha256(std::string_view text);

}  // namespace rgs::tool
