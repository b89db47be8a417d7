// command_line.hpp - arguments of the command-line programs, on top of CLI11, with error messages that say what is
// valid.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <map>
#include <optional>
#include <string>
#include <type_traits>

#include "console.hpp"

namespace rgs::tool {

/// Parses the arguments into the variables of `app`. Returns the exit code if the program ends here: after --help and
/// --version, which it prints, and after an error. Rejects what CLI11 rejects and also empty arguments or values, which
/// would count as absent, and numbers that are not finite, which would pass every range check.
std::optional<int> parse(CLI::App& app, int argc, const char* const* argv);

/// The names of an option's values, with `between` them.
template <class T>
std::string names_of(const std::map<std::string, T>& values, const char* between) {
  std::string names;
  for (const auto& [name, value] : values) names += (names.empty() ? "" : between) + name;
  return names;
}

/// For CLI::Option::transform(): an enumeration's values by name. The option's own text must list them for --help; the
/// error message lists them too.
template <class T>
CLI::Validator one_of(const std::map<std::string, T>& values) {
  static_assert(std::is_enum_v<T>);
  const auto replace = [values](std::string& text) -> std::string {
    if (const auto found = values.find(text); found != values.end()) {
      text = std::to_string(static_cast<std::underlying_type_t<T>>(found->second));
      return {};
    }
    return "'" + text + "' is not one of " + names_of(values, ", ");
  };
  return CLI::Validator(replace, "");
}

/// Adds an option that takes a size in bytes, see parse_bytes(). `bytes`, a std::uint64_t or an optional one, must live
/// until the command line is parsed.
template <class Bytes>
CLI::Option* add_bytes(CLI::App& app, const std::string& name, Bytes& bytes, const std::string& help) {
  const auto read = [name, &bytes](const std::string& text) {
    const auto parsed = parse_bytes(text);
    if (!parsed) throw CLI::ValidationError(name, std::string(parsed.error().what) + ", not '" + text + "'");
    bytes = *parsed;
  };
  return app.add_option_function<std::string>(name, read, help)->option_text("BYTES");
}

}  // namespace rgs::tool
