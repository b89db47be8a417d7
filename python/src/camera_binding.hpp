// camera_binding.hpp - camera values from Python.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include "rgs/scene_first_view.hpp"

namespace rgs::python {

/// The first view of a scene with this origin.
struct PlacedView {
  FirstView view;
  Origin origin;
};

/// An image side, 1 to kMaxImageSide, from any integer; Failure (bad_camera) otherwise.
int image_side(const pybind11::handle& value);

}  // namespace rgs::python
