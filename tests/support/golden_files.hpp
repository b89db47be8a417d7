// golden_files.hpp - the files of tests/golden in this checkout.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "checkout.hpp"
#include "edit_file.hpp"
#include "golden_levels.hpp"

namespace rgs::test {

inline std::filesystem::path golden_folder() {
  return std::filesystem::path(source_dir()) / "tests/golden";
}

inline Bytes golden_file(const std::string& name) {
  return read_bytes(golden_folder() / (name + ".rgs"));
}

/// What encode_levels() gives, or the golden file if an earlier version wrote it.
inline Bytes file_of(const GoldenLevels& scene) {
  return scene.earlier ? golden_file(scene.name) : encode_levels(scene);
}

}  // namespace rgs::test
