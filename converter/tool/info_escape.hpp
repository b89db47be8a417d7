// info_escape.hpp - makes text from a file safe to print on a terminal.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <string_view>

namespace rgs::tool {

/// `text` as one line without effect on a terminal: control characters, invisible characters, those that turn the
/// direction of writing and, with `ascii`, everything beyond ASCII become \u{hex}; bytes that are not UTF-8 become
/// \xHH; a backslash is doubled. Above `limit` bytes the rest is left out, which shows as "...".
std::string escape_untrusted(std::string_view text, bool ascii, std::size_t limit = 256);

}  // namespace rgs::tool
