// text_lines.hpp - the lines of a report for people, as the programs print them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>

#include <iterator>
#include <string>
#include <utility>

namespace rgs::tool {

/// To be inherited by what composes a report.
class TextLines {
 public:
  /// Appends one line of formatted text; spaces at its end, which columns leave behind, are cut off.
  template <class... Args>
  void line(fmt::format_string<Args...> format, Args&&... args) {
    fmt::format_to(std::back_inserter(text_), format, std::forward<Args>(args)...);
    text_.erase(text_.find_last_not_of(' ') + 1);
    text_ += '\n';
  }
  /// All lines, which are then gone.
  std::string take() { return std::exchange(text_, {}); }

 private:
  std::string text_;
};

}  // namespace rgs::tool
