// camera_binding.cpp - cameras, camera files and views of scenes without cameras.
// SPDX-License-Identifier: Apache-2.0
#include "camera_binding.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "work.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace rgs::python {
namespace {

using Vector = std::array<double, 3>;

glm::dvec3 vector(const Vector& v) {
  return {v[0], v[1], v[2]};
}

Vector array(const glm::dvec3& v) {
  return {v.x, v.y, v.z};
}

Camera make(const py::object& width, const py::object& height, double fx, std::optional<double> fy,
            std::optional<double> cx, std::optional<double> cy, const py::object& world_to_camera, std::string name) {
  Camera camera;
  camera.name = std::move(name);
  camera.width = image_side(width);
  camera.height = image_side(height);
  camera.fx = fx;
  camera.fy = fy.value_or(fx);
  camera.cx = cx.value_or(camera.width / 2.0);
  camera.cy = cy.value_or(camera.height / 2.0);
  if (!world_to_camera.is_none()) {
    const Elements matrix(py::module_::import("numpy").attr("ascontiguousarray")(world_to_camera, "d"));
    if (matrix.shape() != Shape{4, 4}) refuse(Errc::bad_camera, "world_to_camera is a matrix of 4 rows and 4 columns");
    std::array<double, 16> rows{};
    std::ranges::copy(matrix.as<double>(), rows.begin());
    camera.world_to_camera = from_row_major(rows);
  }
  take(validate(camera), camera.name);
  return camera;
}

// COLMAP names images by bytes, which need not be text.
std::string as_text(const std::string& name) {
  return py::reinterpret_steal<py::str>(
      PyUnicode_DecodeUTF8(name.data(), static_cast<Py_ssize_t>(name.size()), "replace"));
}

py::object matrix_of(const Camera& camera) {
  py::object matrix = new_array<double>({4, 4});
  std::ranges::copy(row_major(camera.world_to_camera), static_cast<double*>(Elements(matrix).data()));
  return matrix;
}

ViewFormat view_format(const py::object& width, const py::object& height, double horizontal_fov) {
  if (!(horizontal_fov > 0 && horizontal_fov < 180))
    refuse(Errc::bad_camera, "a horizontal field of view is between 0 and 180 degrees");
  return {image_side(width), image_side(height), horizontal_fov};
}

}  // namespace

int image_side(const py::handle& value) {
  const py::object index = py::reinterpret_steal<py::object>(PyNumber_Index(value.ptr()));
  if (!index) throw py::error_already_set();
  int overflow = 0;
  const long long side = PyLong_AsLongLongAndOverflow(index.ptr(), &overflow);
  if (overflow != 0 || side < 1 || side > kMaxImageSide)
    refuse(Errc::bad_camera, "the width or height of a picture is not 1 to 65536 pixels");
  return static_cast<int>(side);
}

void bind_cameras(py::module_& module) {
  py::class_<Camera>(module, "Camera",
                     R"(A pinhole camera, which never changes; roofgs.cameras says which frames it has.

Parameters
----------
width, height : int
    Pixels, 1 to 65536.
fx, fy : float
    Focal lengths, pixels; fy is fx unless it is given.
cx, cy : float
    Principal point, pixels from the left and upper edges; the middle unless it is given.
world_to_camera : array [4, 4]
    Rigid motion to x right, y down, z forward. Without one the camera is in the world's origin.
name : str
    Usually the photograph's file name.
)")
      .def(py::init(&make), "width"_a, "height"_a, "fx"_a, "fy"_a = py::none(), "cx"_a = py::none(),
           "cy"_a = py::none(), "world_to_camera"_a = py::none(), "name"_a = "")
      .def_readonly("name", &Camera::name, "Usually the photograph's file name.")
      .def_readonly("width", &Camera::width, "Pixels.")
      .def_readonly("height", &Camera::height, "Pixels.")
      .def_readonly("fx", &Camera::fx, "Focal length, pixels.")
      .def_readonly("fy", &Camera::fy, "Focal length, pixels.")
      .def_readonly("cx", &Camera::cx, "Principal point, pixels from the left edge.")
      .def_readonly("cy", &Camera::cy, "Principal point, pixels from the upper edge.")
      .def_property_readonly("world_to_camera", &matrix_of, "[4, 4], a copy.")
      .def_property_readonly(
          "centre", [](const Camera& c) { return array(camera_centre(c)); }, "Position in the world.")
      .def(
          "axis",
          [](const Camera& c, int axis) {
            if (axis < 0 || axis > 2) refuse(Errc::bad_argument, "a camera's axes are 0, 1 and 2");
            return array(camera_axis(c, axis));
          },
          "axis"_a, "World direction of its axis 0 (right), 1 (down) or 2 (forward), unit length.")
      .def(
          "resized",
          [](const Camera& c, const py::object& width, const py::object& height) {
            return resized(c, image_side(width), image_side(height));
          },
          "width"_a, "height"_a, "The same view in another size; keeps the horizontal field of view.")
      .def("__eq__",
           [](const Camera& a, const py::object& other) {
             if (!py::isinstance<Camera>(other)) return false;
             const auto& b = other.cast<const Camera&>();
             return a.name == b.name && a.width == b.width && a.height == b.height && a.fx == b.fx && a.fy == b.fy &&
                    a.cx == b.cx && a.cy == b.cy && a.world_to_camera == b.world_to_camera;
           })
      .def("__hash__", [](const Camera& c) { return py::hash(py::make_tuple(c.name, c.width, c.height, c.fx, c.fy)); })
      .def("__repr__",
           [](const Camera& c) {
             return py::str("<roofgs.Camera {!r} {}x{} fx={:g} fy={:g} at ({:.4g}, {:.4g}, {:.4g})>")
                 .format(c.name, c.width, c.height, c.fx, c.fy, camera_centre(c).x, camera_centre(c).y,
                         camera_centre(c).z);
           })
      .def("__reduce__", [](const Camera& c) {
        return py::make_tuple(py::type::of<Camera>(),
                              py::make_tuple(c.width, c.height, c.fx, c.fy, c.cx, c.cy, matrix_of(c), c.name));
      });

  // (source, cameras, which of them are test cameras, whether the file says so)
  module.def(
      "read_cameras",
      [](const std::string& path) {
        static constexpr const char* kSources[] = {"list", "training", "transforms", "colmap"};
        auto set = [&] {  // without threads, so that the process may fork afterwards
          const Unlocked unlocked;
          return take(read_camera_set(path), path);
        }();
        for (Camera& camera : set.cameras) camera.name = as_text(camera.name);
        std::vector<bool> test;
        for (const Split split : set.split) test.push_back(split == Split::test);
        return py::make_tuple(kSources[static_cast<int>(set.source)], py::cast(set.cameras), test, set.split_declared);
      },
      "path"_a);
  module.def(
      "write_cameras",
      [](const std::string& path, const std::string& json, bool overwrite) {
        const Unlocked unlocked;
        auto file = take(AtomicFile::create(path, {.overwrite = overwrite}), path);
        take(file.write_at(0, std::as_bytes(std::span(json))), path);
        take(file.commit(), path);
      },
      "path"_a, "json"_a, "overwrite"_a);
  py::class_<PlacedView>(module, "FirstView");
  module.def(
      "look_at",
      [](const Vector& eye, const Vector& target, const Vector& up, const py::object& width, const py::object& height,
         double horizontal_fov) {
        Camera camera = look_at(vector(eye), vector(target), vector(up), view_format(width, height, horizontal_fov));
        take(validate(camera));
        return camera;
      },
      "eye"_a, "target"_a, "up"_a, "width"_a, "height"_a, "horizontal_fov"_a);
  module.def(
      "orbit",
      [](PlacedView first, int n, const py::object& width, const py::object& height,
         std::optional<double> horizontal_fov) {
        if (n < 1) refuse(Errc::bad_argument, "an orbit has at least one camera");
        if (horizontal_fov) first.view.horizontal_fov = static_cast<float>(*horizontal_fov);
        const auto wide = static_cast<double>(first.view.horizontal_fov);
        return orbit(first.view, first.origin, n, view_format(width, height, wide));
      },
      "view"_a, "n"_a, "width"_a, "height"_a, "horizontal_fov"_a);
  module.def(
      "interpolated_path",
      [](const std::vector<Camera>& keys, int n) {
        if (n < 1 || keys.empty()) refuse(Errc::bad_argument, "a path has at least one key and one frame");
        return interpolated_path(keys, n);
      },
      "keys"_a, "n"_a);
}

}  // namespace rgs::python
