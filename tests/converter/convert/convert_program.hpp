// convert_program.hpp - runs rgs-convert for the tests: outputs are replaced and not synced.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "run_program.hpp"

namespace rgs::test {

inline ProgramResult rgs_convert(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync", "--overwrite"});
  return run_program(arguments);
}

/// The --json output of a successful run.
inline nlohmann::json converted(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), "--json");
  const ProgramResult run = rgs_convert(arguments);
  CAPTURE(arguments);
  CAPTURE(run.err);
  REQUIRE(run.exit_code == 0);
  return nlohmann::json::parse(run.out);
}

}  // namespace rgs::test
