// max_expansion.hpp - the option --max-expansion of every program that reads splat files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdint>
#include <limits>
#include <string>
#include <string_view>

#include "console.hpp"
#include "rgs/decode.hpp"
#include "rgs/result.hpp"

namespace rgs::tool {

/// "4096": compressed data may expand to this many times the file's size. "8GB", by parse_bytes() and with a unit: to
/// this many bytes, whatever the size. Changes nothing else in `limits`. bad_argument for anything else, and 0.
inline Status parse_max_expansion(std::string_view text, DecodeLimits& limits) {
  const Result<std::uint64_t> number = parse_bytes(text);
  const bool has_unit = std::ranges::any_of(text, [](char c) { return c >= 'A'; });
  if (!number || *number == 0 || (!has_unit && text.find('.') != text.npos))
    return make_error(Errc::bad_argument, Error::kNone, "takes a ratio such as 4096 or a size such as 8GB");
  if (has_unit) limits.max_decoded_bytes = *number;
  limits.max_expansion = has_unit ? std::numeric_limits<std::uint64_t>::max() : *number;
  return {};
}

/// Adds the option; `limits` must live until the command line is parsed.
inline CLI::Option* add_max_expansion(CLI::App& app, DecodeLimits& limits) {
  return app
      .add_option_function<std::string>(
          "--max-expansion",
          [&limits](const std::string& text) {
            if (const Status s = parse_max_expansion(text, limits); !s) {
              throw CLI::ValidationError("--max-expansion", std::string(s.error().what) + ", not '" + text + "'");
            }
          },
          "Limit on what a compressed file expands to: a ratio to its size, or bytes such as 8GB [1032]")
      ->option_text("RATIO|SIZE");
}

}  // namespace rgs::tool
