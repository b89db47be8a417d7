// usda_text.cpp - the grammar is that of OpenUSD's "USDA" text file format (openusd.org).
// SPDX-License-Identifier: Apache-2.0
#include "usda_text.hpp"

#include <algorithm>
#include <array>
#include <string>

namespace rgs::detail {
namespace {

constexpr std::size_t kMaxBrackets = 64;
constexpr std::string_view kEndsOfAtom = " \n\t\r;,()[]{}<>\"'@=#";
constexpr auto kEndsAtom = [] {
  std::array<bool, 256> ends{};
  for (const char c : kEndsOfAtom) ends[static_cast<unsigned char>(c)] = true;
  return ends;
}();

bool is_letter(char c) {
  return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_' || static_cast<unsigned char>(c) >= 128;
}

}  // namespace

void UsdaText::fail(Errc code, std::uint64_t offset, const char* what) {
  if (!error_) error_ = make_error(code, offset, what).value();
  at_ = text_.size();
}

void UsdaText::fail(const char* what) {
  if (ends()) return fail(Errc::truncated, at_, "the text ends inside a prim or a value");
  fail(Errc::bad_syntax, at_, what);
}

void UsdaText::skip_comment() {
  if (text_.substr(at_).starts_with("/*")) return skip_past("*/", at_ + 2);
  at_ = std::min(text_.find('\n', at_), text_.size());
}

// After the next `end`, which a backslash hides in texts and in assets of three @.
void UsdaText::skip_past(std::string_view end, std::size_t from) {
  const bool escapes = end[0] == '"' || end[0] == '\'' || end == "@@@";
  for (std::size_t i = from; i < text_.size(); ++i) {
    if (escapes && text_[i] == '\\')
      ++i;
    else if (text_.substr(i).starts_with(end))
      return void(at_ = i + end.size());
  }
  fail(Errc::truncated, at_, "a text, an asset, a path or a comment does not end");
}

std::string_view UsdaText::word() {
  const char first = next();
  const std::size_t start = at_;
  const auto continues = [](char c) { return is_letter(c) || (c >= '0' && c <= '9') || c == ':' || c == '.'; };
  if (is_letter(first))
    while (at_ < text_.size() && continues(text_[at_])) ++at_;
  if (at_ == start) fail("a name or a keyword is missing");
  return ok() ? text_.substr(start, at_ - start) : std::string_view();
}

std::string_view UsdaText::quoted() {
  const char quote = next();
  if (quote != '"' && quote != '\'') return fail("a text in quotes is missing"), std::string_view();
  const std::string three(3, quote);
  const std::size_t width = text_.substr(at_).starts_with(three) ? 3 : 1, start = at_ + width;
  skip_past(std::string_view(three).substr(0, width), start);
  return ok() ? text_.substr(start, at_ - width - start) : std::string_view();
}

std::string_view UsdaText::atom() {
  const std::size_t start = at();
  while (at_ < text_.size() && !kEndsAtom[static_cast<unsigned char>(text_[at_])]) ++at_;
  if (at_ == start) fail("a value is missing");
  return text_.substr(start, ok() ? at_ - start : 0);
}

void UsdaText::skip_value() {
  std::string closing;
  do {
    const char c = next();
    if (c == '"' || c == '\'') {
      quoted();
    } else if (c == '@') {
      const bool three = text_.substr(at_).starts_with("@@@");
      skip_past(three ? "@@@" : "@", at_ + (three ? 3 : 1));
    } else if (c == '<') {
      skip_past(">", at_ + 1);
    } else if (c == '(' || c == '[' || c == '{') {
      closing += c == '(' ? ')' : c == '[' ? ']' : '}';
      if (closing.size() > kMaxBrackets)
        fail("brackets are nested more than 64 deep");
      else
        ++at_;
    } else if (!closing.empty() && c == closing.back()) {
      closing.pop_back();
      ++at_;
    } else if (!closing.empty() && (c == ',' || c == '=')) {
      ++at_;
    } else {
      atom();
    }
  } while (ok() && !closing.empty());
}

}  // namespace rgs::detail
