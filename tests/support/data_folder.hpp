// data_folder.hpp - where the measurement data lies. SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <filesystem>

namespace rgs::test {

/// $RGS_DATA_DIR; without it a folder that does not exist (see skip_without_data).
inline std::filesystem::path data_folder() {
  const char* folder = std::getenv("RGS_DATA_DIR");
  return folder != nullptr && *folder != '\0' ? folder : "RGS_DATA_DIR is not set";
}

}  // namespace rgs::test
