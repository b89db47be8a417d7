// command_line.hpp - arguments of the command-line programs, on top of CLI11: refusals that say what would be right.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <map>
#include <optional>
#include <string>
#include <type_traits>

namespace rgs::tool {

/// What programs read that take any scene, for the text of --help.
#define RGS_SCENE_FORMATS ".rgs, 3DGS .ply, .compressed.ply, .spz, .splat, .ksplat, .sog (or its meta.json) or .glb"

/// Parses the arguments into what `app` fills. Returns the exit code if the program ends here: after --help and
/// --version, which are printed, and after a refusal. Refuses what CLI11 refuses and, because it would count as not given
/// or pass every range, an empty argument or value, and a number that is not finite.
std::optional<int> parse(CLI::App& app, int argc, const char* const* argv);

/// For CLI::Option::transform(): the values of an enumeration by name. --help does not list them, so the option's text has
/// to; a refusal does.
template <class T>
CLI::Validator one_of(const std::map<std::string, T>& values) {
  static_assert(std::is_enum_v<T>);
  const auto replace = [values](std::string& text) -> std::string {
    if (const auto found = values.find(text); found != values.end()) {
      text = std::to_string(static_cast<std::underlying_type_t<T>>(found->second));
      return {};
    }
    std::string names;
    for (const auto& [name, value] : values) names += (names.empty() ? "" : ", ") + name;
    return "'" + text + "' is none of " + names;
  };
  return CLI::Validator(replace, "");
}

}  // namespace rgs::tool
