// counted_program.hpp - runs a program and counts its allocations.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <string>
#include <vector>

#include "checkout.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

namespace rgs::test {

struct CountedResult {
  ProgramResult program;
  std::int64_t peak_bytes = -1;  ///< peak of malloc() and its siblings; mapped files do not count
};

/// Allocations beyond `most_bytes` fail.
inline CountedResult run_counted(const std::vector<std::string>& arguments,
                                 std::int64_t most_bytes = std::numeric_limits<std::int64_t>::max()) {
  const TemporaryFolder folder;
  const std::string path = folder.file("peak");
  CountedResult result{run_program(arguments, [&] {
    ::setenv("LD_PRELOAD", (binary_dir() + "/lib/librgs_counted_memory.so").c_str(), 1);
    ::setenv("RGS_PEAK_FILE", path.c_str(), 1);
    ::setenv("RGS_MOST_BYTES", std::to_string(most_bytes).c_str(), 1);
  })};
  std::ifstream(path) >> result.peak_bytes;
  return result;
}

}  // namespace rgs::test
