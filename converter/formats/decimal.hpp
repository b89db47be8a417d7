// decimal.hpp - numbers in text: as PLY and OpenUSD have them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <charconv>
#include <limits>
#include <string_view>
#include <system_error>

namespace rgs::detail {

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
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (end != text.data() + text.size() || error == std::errc::invalid_argument) return false;
  if (error == std::errc::result_out_of_range) value = out_of_range_value<Number>(text);
  return true;
}

}  // namespace rgs::detail
