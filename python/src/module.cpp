// module.cpp - the extension module _roofgs.
// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"
#include "rgs/version.hpp"

namespace {

// For an object whose __init__ never ran pybind11 allocates a C++ object, by operator new if its class has one, and leaves it
// as it is.
void* refuse_without_init(std::size_t) {
  throw pybind11::type_error("the object has no value: its __init__ was not called");
}

void refuse_objects_without_init(const pybind11::module_& module) {
  for (const auto& member : module.attr("__dict__").cast<pybind11::dict>()) {
    if (PyType_Check(member.second.ptr()) == 0) continue;
    auto* const type = reinterpret_cast<PyTypeObject*>(member.second.ptr());
    if (auto* const info = pybind11::detail::get_type_info(type)) info->operator_new = &refuse_without_init;
  }
}

}  // namespace

PYBIND11_MODULE(_roofgs, module) {
  module.attr("version") = RGS_VERSION;
  rgs::python::bind_work(module);
  rgs::python::bind_arrays(module);
  rgs::python::bind_device_array(module);
  rgs::python::bind_cameras(module);
  rgs::python::bind_scene(module);
  rgs::python::bind_stream(module);
  rgs::python::bind_render(module);
  refuse_objects_without_init(module);
}
