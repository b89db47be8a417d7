// info_escape.hpp - makes text from a file safe to print on a terminal.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <string_view>

namespace rgs::tool {

/// `text` as one line that cannot control a terminal: control characters, invisible characters, those that change the
/// writing direction and, with `ascii`, everything beyond ASCII become \u{hex}; bytes that are not UTF-8 become \xHH; a
/// backslash is doubled. Text beyond `limit` bytes is cut and ends in "...".
std::string escape_untrusted(std::string_view text, bool ascii, std::size_t limit = 256);

}  // namespace rgs::tool
