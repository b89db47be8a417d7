// scene_binding.hpp - a scene as the module holds it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "scene_file.hpp"

namespace rgs::python {

struct PyScene {
  SceneFile file;
  std::string path;  ///< or address; empty for a scene from arrays
};

}  // namespace rgs::python
