// module.cpp - the extension module _roofgs.
// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"
#include "rgs/version.hpp"

PYBIND11_MODULE(_roofgs, module) {
  module.attr("version") = RGS_VERSION;
  rgs::python::bind_work(module);
  rgs::python::bind_arrays(module);
  rgs::python::bind_device_array(module);
  rgs::python::bind_cameras(module);
  rgs::python::bind_scene(module);
  rgs::python::bind_stream(module);
  rgs::python::bind_render(module);
}
