// decimal.hpp - numbers in text: as PLY and OpenUSD have them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cerrno>
#include <charconv>
#include <cstdlib>
#include <limits>
#include <string>
#include <string_view>
#include <system_error>

namespace rgs::detail {

/// std::from_chars(), which libc++ does not have for these numbers.
template <class Number>
std::from_chars_result from_decimal(std::string_view text, Number& value) {
#if defined(__cpp_lib_to_chars)
  return std::from_chars(text.data(), text.data() + text.size(), value);
#else
  std::string number(text);
  const std::size_t digits = text.starts_with('-') ? 1 : 0;
  const char next = digits < text.size() ? text[digits] : ' ';
  // What strtod() takes besides.
  if (next == '+' || (digits == 1 && next == '-') ||
      std::string_view(" \t\n\v\f\r").find(next) != std::string_view::npos)
    return {text.data(), std::errc::invalid_argument};
  if (next == '0' && (number[digits + 1] | 32) == 'x') number.resize(digits + 1);
  char* end = nullptr;
  errno = 0;
  const Number parsed = sizeof(Number) == sizeof(float) ? static_cast<Number>(std::strtof(number.c_str(), &end))
                                                        : static_cast<Number>(std::strtod(number.c_str(), &end));
  const char* const ptr = text.data() + (end - number.c_str());
  if (ptr == text.data()) return {ptr, std::errc::invalid_argument};
  const bool out_of_range = errno == ERANGE && (parsed == 0 || parsed > std::numeric_limits<Number>::max() ||
                                                parsed < std::numeric_limits<Number>::lowest());
  if (out_of_range) return {ptr, std::errc::result_out_of_range};
  value = parsed;
  return {ptr, std::errc()};
#endif
}

// from_chars reports overflow and underflow alike: 0 if the magnitude is below 1, else infinity.
template <class Number>
Number out_of_range_value(std::string_view text) {
  const bool negative = text.front() == '-';
  const std::size_t exponent = text.find_first_of("eE");
  const bool tiny = exponent != text.npos ? text[exponent + 1] == '-'
                                          : text.substr(0, text.find('.')).find_first_of("123456789") == text.npos;
  const Number magnitude = tiny ? 0 : std::numeric_limits<Number>::infinity();
  return negative ? -magnitude : magnitude;
}

/// All of `text` as the nearest number. False if it is none.
template <class Number>
bool parse_number(std::string_view text, Number& value) {
  if (text.size() > 1 && text[0] == '+' && text[1] != '-') text.remove_prefix(1);
  const auto [end, error] = from_decimal(text, value);
  if (end != text.data() + text.size() || error == std::errc::invalid_argument) return false;
  if (error == std::errc::result_out_of_range) value = out_of_range_value<Number>(text);
  return true;
}

}  // namespace rgs::detail
