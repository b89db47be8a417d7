// device_array.hpp - arrays in GPU memory: foreign ones, which describe themselves, and the module's own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>

#include "arrays.hpp"
#include "rgs/renderer.hpp"

namespace rgs::python {

/// The library's memory, exported by DLPack or __cuda_array_interface__.
struct DeviceArray {
  DeviceBlock block;
  Shape shape;
  char format;  ///< kFormat<float> or kFormat<std::uint8_t>

  std::uint64_t element_bytes() const { return format == kFormat<float> ? 4 : 1; }
  std::uint64_t bytes() const;
};

}  // namespace rgs::python
