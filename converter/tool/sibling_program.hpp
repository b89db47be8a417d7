// sibling_program.hpp - finds the running program's folder, and runs another of the project's programs from it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

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
Result<int> run_program_and_wait(const std::string& path, const std::vector<std::string>& arguments, int output = 1);

/// Has started programs open what is open here, without a name or with one that is to change.
class NameForPrograms {
 public:
  explicit NameForPrograms(int fd);
  ~NameForPrograms();
  NameForPrograms(const NameForPrograms&) = delete;
  NameForPrograms& operator=(const NameForPrograms&) = delete;
  /// Opens the file's bytes as long as this value lives; empty, and errno was set, if that cannot be.
  const std::string& path() const { return path_; }

 private:
  std::string path_;
  int inherited_ = -1;
};

}  // namespace rgs::tool
