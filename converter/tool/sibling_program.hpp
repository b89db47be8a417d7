// sibling_program.hpp - where the running program lies, and running another one of this project beside it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::tool {

/// The folder of the running program. Error: open_failed.
Result<std::string> program_folder();

/// Path of program `name` in the folder of the running program. Error: open_failed if it is not there or cannot be run.
Result<std::string> sibling_program(const std::string& name);

/// Runs `path` with `arguments`, standard streams shared, and waits. Returns its exit code, 128 + number if a signal
/// ended it. Error: internal if it cannot be started.
Result<int> run_program_and_wait(const std::string& path, const std::vector<std::string>& arguments);

}  // namespace rgs::tool
