// arrays.cpp - the library's memory as arrays.
// SPDX-License-Identifier: Apache-2.0
#include "arrays.hpp"

#include <pybind11/stl.h>

#include <utility>

#include "bindings.hpp"

namespace py = pybind11;

namespace rgs::python {
namespace {

// Keeps an array's memory alive.
struct Memory {
  py::object owner;
  const float* data;
  Shape shape, strides;
};

}  // namespace

py::object readonly_array(py::object owner, const float* data, Shape shape, Shape strides) {
  return py::module_::import("numpy").attr("asarray")(
      py::cast(Memory{std::move(owner), data, std::move(shape), std::move(strides)}));
}

void bind_arrays(py::module_& module) {
  py::class_<Memory> memory(module, "_Memory", py::buffer_protocol(), py::module_local());
  memory.def_buffer([](const Memory& m) {
    return py::buffer_info(const_cast<float*>(m.data), sizeof(float), "f", static_cast<py::ssize_t>(m.shape.size()),
                           m.shape, m.strides, true);
  });
  // Nothing catches an exception of the buffer's function, so that Python makes none.
  reinterpret_cast<PyTypeObject*>(memory.ptr())->tp_new = nullptr;
}

}  // namespace rgs::python
