// device_array.cpp - pictures in GPU memory as Python objects.
// SPDX-License-Identifier: Apache-2.0
#include "device_array.hpp"

#include <dlpack/dlpack.h>
#include <pybind11/stl.h>

#include <memory>
#include <vector>

#include "bindings.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace rgs::python {
namespace {

// Owned by the capsule's consumer until it calls the deleter.
struct Managed {
  DLManagedTensor tensor{};
  std::vector<std::int64_t> shape;
  DeviceBlock block;
};

void release(DLManagedTensor* tensor) {
  delete static_cast<Managed*>(tensor->manager_ctx);
}

// A capsule that was not consumed; a consumed one is named "used_dltensor".
void release_unused(PyObject* capsule) {
  if (PyCapsule_IsValid(capsule, "dltensor") == 0) return;
  release(static_cast<DLManagedTensor*>(PyCapsule_GetPointer(capsule, "dltensor")));
}

// The work is complete: any stream may read it at once.
py::object dlpack(const DeviceArray& array, const py::object&, const py::object&, const py::object& device,
                  const py::object& copy) {
  if (!device.is_none() && !device.equal(py::make_tuple(int{kDLCUDA}, array.block.device)))
    throw py::buffer_error("the array is not copied to another device");
  if (!copy.is_none() && py::bool_(copy)) throw py::buffer_error("the array is not copied");
  auto managed = std::make_unique<Managed>();
  managed->shape.assign(array.shape.begin(), array.shape.end());
  managed->block = array.block;
  DLTensor& t = managed->tensor.dl_tensor;
  t.data = array.block.data.get();
  t.device = {kDLCUDA, array.block.device};
  t.ndim = static_cast<int>(managed->shape.size());
  t.dtype = array.format == kFormat<float> ? DLDataType{kDLFloat, 32, 1} : DLDataType{kDLUInt, 8, 1};
  t.shape = managed->shape.data();
  managed->tensor.manager_ctx = managed.get();
  managed->tensor.deleter = &release;
  PyObject* const capsule = PyCapsule_New(&managed->tensor, "dltensor", &release_unused);
  if (capsule == nullptr) throw py::error_already_set();
  (void)managed.release();
  return py::reinterpret_steal<py::object>(capsule);
}

}  // namespace

std::uint64_t DeviceArray::bytes() const {
  std::uint64_t bytes = element_bytes();
  for (const py::ssize_t side : shape) bytes *= static_cast<std::uint64_t>(side);
  return bytes;
}

void bind_device_array(py::module_& module) {
  const auto shape_of = [](const DeviceArray& a) { return py::tuple(py::cast(a.shape)); };
  const auto dtype_of = [](const DeviceArray& a) { return a.format == kFormat<float> ? "float32" : "uint8"; };
  py::class_<DeviceArray>(
      module, "DeviceArray",
      R"(Pictures in a GPU's memory, for whoever takes arrays by DLPack (torch.from_dlpack(), cupy.from_dlpack()) or by
__cuda_array_interface__. They are complete. The memory lives as long as this or any array that was made of it.
)")
      .def_property_readonly("shape", shape_of,
                             "[height, width, 3] or [height, width], after an axis for several cameras.")
      .def_property_readonly("dtype", dtype_of, "\"float32\" or \"uint8\".")
      .def_property_readonly(
          "nbytes", [](const DeviceArray& a) { return a.bytes(); }, "Bytes.")
      .def_property_readonly(
          "__cuda_array_interface__",
          [shape_of](const DeviceArray& a) {
            return py::dict("shape"_a = shape_of(a), "typestr"_a = a.format == kFormat<float> ? "<f4" : "|u1",
                            "data"_a = py::make_tuple(reinterpret_cast<std::uintptr_t>(a.block.data.get()), false),
                            "version"_a = 3, "strides"_a = py::none(), "stream"_a = py::none());
          })
      .def("__dlpack_device__", [](const DeviceArray& a) { return py::make_tuple(int{kDLCUDA}, a.block.device); })
      .def("__dlpack__", &dlpack, py::kw_only(), "stream"_a = py::none(), "max_version"_a = py::none(),
           "dl_device"_a = py::none(), "copy"_a = py::none())
      .def("__repr__", [shape_of, dtype_of](const DeviceArray& a) {
        return py::str("<roofgs.DeviceArray {} {} on cuda:{}>").format(dtype_of(a), shape_of(a), a.block.device);
      });
}

}  // namespace rgs::python
