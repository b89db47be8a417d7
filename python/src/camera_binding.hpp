// camera_binding.hpp - numbers of cameras from Python.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include "rgs/camera.hpp"

namespace rgs::python {

/// A side of an image, 1 to kMaxImageSide, of whatever is an integer; Failure (bad_camera) for others.
int image_side(const pybind11::handle& value);

}  // namespace rgs::python
