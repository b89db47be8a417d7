// sibling_program.hpp - finds the running program's folder, and runs another of the project's programs from it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <unistd.h>

#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::tool {

/// The folder of the running program. Error: open_failed.
Result<std::string> program_folder();

/// Path of program `name` in the folder of the running program. Error: open_failed if it is absent or not executable.
Result<std::string> sibling_program(const std::string& name);

/// Runs `path` with `arguments`, sharing standard streams, where `output` may replace its standard output, and waits.
/// Returns its exit code, 128 + number if a signal ended it. Error: internal if it cannot be started.
Result<int> run_program_and_wait(const std::string& path, const std::vector<std::string>& arguments,
                                 int output = STDOUT_FILENO);

}  // namespace rgs::tool
