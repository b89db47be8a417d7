// photo_folder.hpp - finds the photograph of a camera in a folder, by the camera's name.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>

#include "rgs/result.hpp"

namespace rgs {

class PhotoFolder {
 public:
  /// Looks at names only. Error: open_failed (the folder cannot be read).
  static Result<PhotoFolder> open(const std::string& path);

  /// The file of the camera of this name, empty if there is none: an exact match or, if the camera's name has a
  /// picture's extension or none, the same name with another extension.
  std::string find(const std::string& camera_name) const;

 private:
  std::map<std::string, std::string> files_;
};

}  // namespace rgs
