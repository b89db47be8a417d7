// stream_binding.cpp - streamed scenes.
// SPDX-License-Identifier: Apache-2.0
#include "stream_binding.hpp"

#include <pybind11/stl.h>

#include <cstdint>
#include <optional>
#include <stop_token>
#include <string>
#include <utility>

#include "bindings.hpp"
#include "camera_binding.hpp"
#include "rgs/camera.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace rgs::python {
namespace {

StreamPool make_pool(std::uint64_t host_memory, std::uint64_t device_memory) {
  begin_work();
  return take(StreamPool::create({.host_memory = host_memory, .device_memory = device_memory}));
}

PyStream open(const std::string& name, const StreamPool& pool, bool prefetch,
              std::optional<std::uint64_t> max_expansion, double open_seconds) {
  const std::stop_source stop;
  const auto work = [=]() -> Result<Scene> {
    OpenOptions options;
    options.pool = pool;
    options.prefetch = prefetch;
    options.url.stop = stop.get_token();
    options.url.open_seconds = open_seconds;
    if (max_expansion) options.limits.max_expansion = *max_expansion;
    return Scene::open(name, options);
  };
  return {take(run_stoppable(work, nullptr, stop), name), name};
}

// A query under the pool's lock, which a thread lost in a fork may hold. The scene is a copy, because another thread may close it; the
// last copy waits for threads, so it is destroyed first.
template <class Value>
Value asked(const PyStream& stream, Value (Scene::*question)() const) {
  begin_work();
  Scene copy = stream.scene();
  const Unlocked unlocked;
  const Scene held = std::move(copy);
  return (held.*question)();
}

py::dict stats(const PyStream& stream) {
  const StreamStats s = asked(stream, &Scene::stats);
  return py::dict("pages_resident"_a = s.pages_resident, "pages_missing"_a = s.pages_missing,
                  "bytes_read"_a = s.bytes_read, "bytes_decoded"_a = s.bytes_decoded,
                  "bytes_uploaded"_a = s.bytes_uploaded, "bytes_evicted"_a = s.bytes_evicted,
                  "detail_reached_px"_a = s.detail_reached_px);
}

}  // namespace

void bind_stream(py::module_& module) {
  // Like asked().
  const auto held = [](std::uint64_t (StreamPool::*bytes)() const) {
    return [bytes](const StreamPool& pool) {
      begin_work();
      const Unlocked unlocked;
      return (pool.*bytes)();
    };
  };
  py::class_<StreamPool>(module, "StreamPool")
      .def(py::init(&make_pool), "host_memory"_a, "device_memory"_a)
      .def_property_readonly("host_memory", &StreamPool::host_memory)
      .def_property_readonly("device_memory", &StreamPool::device_memory)
      .def_property_readonly("host_bytes", held(&StreamPool::host_bytes))
      .def_property_readonly("device_bytes", held(&StreamPool::device_bytes));
  py::class_<PyStream>(module, "StreamedScene")
      .def_property_readonly("name", [](const PyStream& s) { return py::bytes(s.name()); })
      .def_property_readonly("n", [](const PyStream& s) { return s.scene().size(); })
      .def_property_readonly("sh_degree", [](const PyStream& s) { return s.scene().sh_degree(); })
      .def_property_readonly("origin", [](const PyStream& s) { return s.scene().origin(); })
      .def_property_readonly("bounds",
                             [](const PyStream& s) {
                               const auto [low, high] = take(subject_bounds(s.scene()), s.name());
                               return py::make_tuple(py::make_tuple(low.x, low.y, low.z),
                                                     py::make_tuple(high.x, high.y, high.z));
                             })
      .def_property_readonly("first_view",
                             [](const PyStream& s) {
                               const Scene& scene = s.scene();
                               const glm::dvec3 up = declared_up(*scene.declarations());
                               return PlacedView{take(first_view(scene, up), s.name()), scene.origin()};
                             })
      .def_property_readonly("up",
                             [](const PyStream& s) {
                               const glm::dvec3 up = declared_up(*s.scene().declarations());
                               return py::make_tuple(up.x, up.y, up.z);
                             })
      .def_property_readonly("closed", &PyStream::closed)
      .def("stats", &stats)
      .def("check", [](const PyStream& s) { take(asked(s, &Scene::status), s.name()); })
      .def("close", &PyStream::close);
  module.def("open_stream", &open, "name"_a, "pool"_a, "prefetch"_a, "max_expansion"_a, "open_seconds"_a);
}

}  // namespace rgs::python
