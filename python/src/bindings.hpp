// bindings.hpp - the parts of the extension module _roofgs, one file each. The public API is python/roofgs.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

namespace rgs::python {

void bind_work(pybind11::module_& module);
void bind_arrays(pybind11::module_& module);
void bind_device_array(pybind11::module_& module);
void bind_cameras(pybind11::module_& module);
void bind_scene(pybind11::module_& module);
void bind_stream(pybind11::module_& module);
void bind_render(pybind11::module_& module);

}  // namespace rgs::python
