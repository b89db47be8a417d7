// command_line.cpp - parses arguments, and rejects some that CLI11 accepts but no program can mean.
// SPDX-License-Identifier: Apache-2.0
#include "command_line.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <string_view>
#include <utility>
#include <vector>

#include "system.hpp"

namespace rgs::tool {
namespace {

// A message for an empty argument, "--option ''" or "--option="; empty if there is none.
std::string empty_argument(const std::vector<std::string>& arguments) {
  for (std::size_t i = 1; i < arguments.size(); ++i) {
    const std::string_view argument = arguments[i], before = arguments[i - 1];
    const std::size_t equals = argument.find('=');
    if (argument.starts_with("-") && equals != argument.npos && equals + 1 == argument.size())
      return std::string(argument.substr(0, equals)) + " has an empty value";
    if (!argument.empty()) continue;
    return i > 1 && before.size() > 1 && before.starts_with("-") ? std::string(before) + " has an empty value"
                                                                 : "an argument is empty";
  }
  return {};
}

// CLI11's range checks let NaN pass.
std::string number_not_finite(const CLI::App& app) {
  for (const CLI::Option* option : app.get_options()) {
    if (option->get_type_name().find("FLOAT") == std::string::npos) continue;  // "[FLOAT,FLOAT,FLOAT]" too
    for (const std::string& text : option->results()) {
      char* end = nullptr;
      const double value = std::strtod(text.c_str(), &end);
      if (end != text.c_str() && !std::isfinite(value))
        return option->get_name() + " takes a finite number, not " + text;
    }
  }
  return {};
}

}  // namespace

std::optional<int> parse(CLI::App& app, int argc, const char* const* argv) {
  std::vector<std::string> arguments = arguments_of(argc, argv);
  if (const std::string wrong = empty_argument(arguments); !wrong.empty()) return report_usage(wrong);
  try {
    std::reverse(arguments.begin(), arguments.end());
    if (!arguments.empty()) arguments.pop_back();  // the program's name
    app.parse(std::move(arguments));
  } catch (const CLI::CallForVersion& e) {
    print(std::string(e.what()) + "\n");
    return kSuccess;
  } catch (const CLI::Success&) {
    print(app.help());
    return kSuccess;
  } catch (const CLI::ParseError& e) {
    return report_usage(e.what());
  }
  if (const std::string wrong = number_not_finite(app); !wrong.empty()) return report_usage(wrong);
  return std::nullopt;
}

}  // namespace rgs::tool
