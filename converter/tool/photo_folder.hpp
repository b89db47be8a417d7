// photo_folder.hpp - the photographs of a folder, by the names of the cameras that took them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>

#include "rgs/result.hpp"

namespace rgs {

class PhotoFolder {
 public:
  /// Looks at names alone. Error: open_failed (the folder cannot be read).
  static Result<PhotoFolder> open(const std::string& path);

  /// The file of the camera of this name, empty if there is none: of its full name or, where the camera's ends as a picture's or has no
  /// ending, of that name and another ending.
  std::string find(const std::string& camera_name) const;

 private:
  std::map<std::string, std::string> files_;
};

}  // namespace rgs
