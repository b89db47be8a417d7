// arrays.hpp - NumPy arrays through the buffer protocol alone.
// SPDX-License-Identifier: Apache-2.0
//
// pybind11/numpy.h reads NumPy's own structures, which NumPy 2 changed: built with pybind11 before 2.12 it gets wrong strides. The
// buffer protocol is the same for all versions.
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>
#include <span>
#include <type_traits>
#include <vector>

namespace rgs::python {

using Shape = std::vector<pybind11::ssize_t>;

template <class T>
inline constexpr char kFormat = 0;
template <>
inline constexpr char kFormat<float> = 'f';
template <>
inline constexpr char kFormat<double> = 'd';
template <>
inline constexpr char kFormat<std::uint8_t> = 'B';

/// An array's memory, pinned while this lives.
class Elements {
 public:
  /// From any object with the buffer protocol, else TypeError.
  explicit Elements(const pybind11::object& array)
      : info_(pybind11::reinterpret_borrow<pybind11::buffer>(array).request()) {}

  template <class T>
  bool are() const {
    return info_.format.size() == 1 && info_.format[0] == kFormat<T>;
  }
  const Shape& shape() const { return info_.shape; }
  bool is_contiguous() const { return PyBuffer_IsContiguous(info_.view(), 'C') != 0; }
  bool is_readonly() const { return info_.readonly; }
  pybind11::ssize_t bytes() const { return info_.size * info_.itemsize; }
  void* data() const { return info_.ptr; }
  /// Requires a contiguous array.
  template <class T>
  std::span<const T> as() const {
    return {static_cast<const T*>(info_.ptr), static_cast<std::size_t>(info_.size)};
  }

 private:
  pybind11::buffer_info info_;
};

/// numpy.empty() of this element type.
template <class T>
pybind11::object new_array(const Shape& shape) {
  const char format[2] = {kFormat<T>, 0};
  return pybind11::module_::import("numpy").attr("empty")(pybind11::tuple(pybind11::cast(shape)), format);
}

/// A read-only array of memory that `owner` keeps alive. Strides in bytes.
pybind11::object readonly_array(pybind11::object owner, const float* data, Shape shape, Shape strides);

}  // namespace rgs::python
