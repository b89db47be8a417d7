// stream_binding.hpp - a streamed scene as the module holds it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include <memory>
#include <string>
#include <utility>

#include "rgs/scene.hpp"
#include "work.hpp"

namespace rgs::python {

class PyStream {
 public:
  PyStream(Scene scene, std::string name) : scene_(std::make_unique<Scene>(std::move(scene))), name_(std::move(name)) {}
  PyStream(PyStream&&) = default;
  PyStream& operator=(PyStream&&) = delete;
  ~PyStream() { close(); }

  /// Failure (bad_argument) once it is closed.
  const Scene& scene() const {
    if (!scene_) refuse(Errc::bad_argument, "the scene is closed", name_);
    return *scene_;
  }
  const std::string& name() const { return name_; }
  bool closed() const { return scene_ == nullptr; }
  /// Ends its threads. A forked process lost them and cannot wait: what they hold stays.
  void close() {
    if (!scene_) return;
    if (lost_threads()) {
      (void)scene_.release();
      return;
    }
    auto last = std::move(scene_);
    const Unlocked unlocked;
    last.reset();
  }

 private:
  std::unique_ptr<Scene> scene_;
  std::string name_;
};

}  // namespace rgs::python
