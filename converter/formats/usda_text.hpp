// usda_text.hpp - the tokens and values of OpenUSD's text format (.usda).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string_view>

#include "decimal.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Reads a text from its begin. Failure is sticky: the first error holds, and after it the text is at its end, so that
/// loops "while ok()" stop. Every function skips blanks and comments first.
class UsdaText {
 public:
  explicit UsdaText(std::string_view text) : text_(text) {}

  bool ok() const { return !error_; }
  Status status() const { return error_ ? Status(tl::unexpected(*error_)) : Status(); }
  void fail(Errc code, std::uint64_t offset, const char* what);
  /// bad_syntax here, or truncated at the end of the text.
  void fail(const char* what);

  /// The offset of the next character.
  std::uint64_t at() { return skip_blanks(), at_; }
  /// 0 at the end.
  char next() { return skip_blanks(), at_ < text_.size() ? text_[at_] : '\0'; }
  bool ends() { return at() == text_.size(); }
  bool take(char c) { return next() == c && ++at_ != 0; }
  void expect(char c) {
    if (!take(c)) fail("the text is not in the grammar of .usda");
  }
  /// A name or keyword: with its namespaces, and with what follows a dot.
  std::string_view word();
  /// A text in single, double or triple quotes, without these; escapes stay.
  std::string_view quoted();
  /// What stands up to the next blank, bracket, comma or quote.
  std::string_view atom();
  template <class Number>
  Number number() {
    Number value = 0;
    const std::uint64_t start = at();
    if (!parse_number(atom(), value)) fail(Errc::bad_syntax, start, "a value is not a number");
    return value;
  }
  /// Any value: an atom, a text, an asset, a path, or brackets with all that is in them.
  void skip_value();

 private:
  void skip_blanks() {
    // The bulk of a file is numbers, where at most one blank stands between two.
    while (at_ < text_.size() && (is_blank(text_[at_]) || starts_comment())) {
      if (is_blank(text_[at_]))
        ++at_;
      else
        skip_comment();
    }
  }
  static bool is_blank(char c) { return c == ' ' || c == '\n' || c == '\t' || c == '\r' || c == ';'; }
  bool starts_comment() const {
    if (text_[at_] == '#') return true;
    return text_[at_] == '/' && at_ + 1 < text_.size() && (text_[at_ + 1] == '/' || text_[at_ + 1] == '*');
  }
  void skip_comment();
  void skip_past(std::string_view end, std::size_t from);

  std::string_view text_;
  std::size_t at_ = 0;
  std::optional<Error> error_;
};

}  // namespace rgs::detail
