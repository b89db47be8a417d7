// ppm_file.hpp - binary PPM pictures, which need no library.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>

#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs::bench {

/// Reads "P6" with 8 bits a channel as [height, width, 3], codes divided by 255. Sides are 1..65536.
/// Errors: bad_magic, bad_syntax (the header; byte offset), unsupported_feature (a maximum other than 255), truncated,
/// trailing_bytes.
Result<Image> parse_ppm(std::span<const std::byte> bytes);
/// The same from a file. Errors also: open_failed, read_failed.
Result<Image> read_ppm(const std::string& path);

}  // namespace rgs::bench
