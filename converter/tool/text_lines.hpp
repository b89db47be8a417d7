// text_lines.hpp - composes the lines of a printed report.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>

#include <iterator>
#include <string>
#include <utility>

namespace rgs::tool {

/// Base class of report composers.
class TextLines {
 public:
  /// Appends one line of formatted text without trailing spaces.
  template <class... Args>
  void line(fmt::format_string<Args...> format, Args&&... args) {
    fmt::format_to(std::back_inserter(text_), format, std::forward<Args>(args)...);
    text_.erase(text_.find_last_not_of(' ') + 1);
    text_ += '\n';
  }
  /// Returns all lines and clears them.
  std::string take() { return std::exchange(text_, {}); }

 private:
  std::string text_;
};

}  // namespace rgs::tool
