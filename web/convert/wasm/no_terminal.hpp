// no_terminal.hpp - stands in for converter/tool/console.hpp, whose programs have a terminal.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace rgs::tool {

/// Unchanged: a page shows it as text.
inline std::string printable(std::string_view text) {
  return std::string(text);
}

}  // namespace rgs::tool
