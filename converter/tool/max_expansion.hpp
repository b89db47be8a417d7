// max_expansion.hpp - the option --max-expansion of every program that reads splat files.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <array>
#include <charconv>
#include <cstdint>
#include <limits>
#include <string>
#include <string_view>
#include <utility>

#include "rgs/decode.hpp"
#include "rgs/result.hpp"

namespace rgs::tool {

/// "4096": compressed data may expand to this many times the file's size. "8GB", "512MiB" (kB to TB, KiB to TiB): to
/// this many bytes, whatever the size. Changes nothing else in `limits`. bad_argument for anything else, and 0.
inline Status parse_max_expansion(std::string_view text, DecodeLimits& limits) {
  constexpr std::array<std::pair<std::string_view, std::uint64_t>, 9> kUnits = {{{"kB", 1000},
                                                                                 {"MB", 1'000'000},
                                                                                 {"GB", 1'000'000'000},
                                                                                 {"TB", 1'000'000'000'000},
                                                                                 {"KiB", std::uint64_t{1} << 10},
                                                                                 {"MiB", std::uint64_t{1} << 20},
                                                                                 {"GiB", std::uint64_t{1} << 30},
                                                                                 {"TiB", std::uint64_t{1} << 40},
                                                                                 {"", 1}}};
  constexpr std::uint64_t kMost = std::numeric_limits<std::uint64_t>::max();
  std::uint64_t number = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
  const std::string_view unit(end, static_cast<std::size_t>(text.data() + text.size() - end));
  for (const auto& [name, bytes] : kUnits) {
    if (error != std::errc() || unit != name || number == 0 || number > kMost / bytes) continue;
    if (name.empty()) {
      limits.max_expansion = number;
    } else {
      limits.max_expansion = kMost;
      limits.max_decoded_bytes = number * bytes;
    }
    return {};
  }
  return make_error(Errc::bad_argument, Error::kNone, "takes a ratio such as 4096 or a size such as 8GB");
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
