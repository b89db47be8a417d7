// checkout.hpp - where this checkout and its build are, found at run time: no object depends on it, so that ccache has
// those of other checkouts.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>

namespace rgs::test {

/// The build folder: programs, this one among them, are in its bin/, libraries in its lib/.
inline std::string binary_dir() {
  return std::filesystem::read_symlink("/proc/self/exe").parent_path().parent_path().string();
}

inline std::string source_dir() {
  const std::string note = binary_dir() + "/source_dir.txt";  // by tests/CMakeLists.txt
  std::string folder;
  if (!std::getline(std::ifstream(note), folder))
    throw std::runtime_error(note + " cannot be read: tests run from bin/ of the folder that CMake configured");
  return folder;
}

}  // namespace rgs::test
