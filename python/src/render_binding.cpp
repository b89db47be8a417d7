// render_binding.cpp - pictures of scenes, into arrays that Python holds.
// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "bindings.hpp"
#include "rgs/image.hpp"
#include "rgs/renderer.hpp"
#include "scene_binding.hpp"
#include "stream_binding.hpp"
#include "work.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace rgs::python {
namespace {

const Scene& drawn(const PyScene& scene) {
  return scene.file.scene;
}
const StreamedScene& drawn(const PyStream& scene) {
  return scene.scene();
}
const std::string& name_of(const PyScene& scene) {
  return scene.path;
}
const std::string& name_of(const PyStream& scene) {
  return scene.name();
}

// Arrays of a call: pictures follow each other.
struct Outputs {
  py::object image, alpha = py::none(), depth = py::none();  // None where not asked for
  float* rgb = nullptr;                                      // one of the two
  std::uint8_t* codes = nullptr;
  float* alpha_data = nullptr;
  float* depth_data = nullptr;
};

template <class T>
T* writable(const py::object& object, const std::vector<py::ssize_t>& shape) {
  if (!py::isinstance<py::array>(object)) refuse(Errc::bad_argument, "an output is a NumPy array");
  auto array = py::reinterpret_borrow<py::array>(object);
  if (!array.dtype().is(py::dtype::of<T>()) && !array.dtype().equal(py::dtype::of<T>()))
    refuse(Errc::bad_argument, "an output has another data type than the picture: float32 or, of images alone, uint8");
  if (array.ndim() != static_cast<py::ssize_t>(shape.size()) || !std::equal(shape.begin(), shape.end(), array.shape()))
    refuse(Errc::bad_argument,
           "an output has another shape than the pictures: [height, width, 3] for colour and [height, width] for alpha "
           "and "
           "depth, with the number of cameras before that for a list of cameras");
  if ((array.flags() & py::array::c_style) == 0)
    refuse(Errc::bad_argument, "an output has gaps or another order of axes: it must be C-contiguous");
  if (!array.writeable()) refuse(Errc::bad_argument, "an output is read-only");
  return static_cast<T*>(array.mutable_data());
}

bool overlap(const py::object& a, const py::object& b) {
  if (a.is_none() || b.is_none()) return false;
  const auto x = py::reinterpret_borrow<py::array>(a), y = py::reinterpret_borrow<py::array>(b);
  const auto *first = static_cast<const std::byte*>(x.data()), *other = static_cast<const std::byte*>(y.data());
  const std::less<> before;
  return before(first, other + y.nbytes()) && before(other, first + x.nbytes());
}

// `wanted`: whether there is one; an array to fill or None, for which one is made.
Outputs outputs_of(std::vector<py::ssize_t> shape, py::object image, py::object alpha, py::object depth, bool eight_bit,
                   bool with_alpha, bool with_depth) {
  Outputs out;
  std::vector<py::ssize_t> with_channels = shape;
  with_channels.push_back(3);
  if (eight_bit) {
    if (image.is_none()) image = py::array_t<std::uint8_t>(with_channels);
    out.codes = writable<std::uint8_t>(image, with_channels);
  } else {
    if (image.is_none()) image = py::array_t<float>(with_channels);
    out.rgb = writable<float>(image, with_channels);
  }
  out.image = std::move(image);
  if (with_alpha) {
    if (alpha.is_none()) alpha = py::array_t<float>(shape);
    out.alpha_data = writable<float>(alpha, shape);
    out.alpha = std::move(alpha);
  }
  if (with_depth) {
    if (depth.is_none()) depth = py::array_t<float>(shape);
    out.depth_data = writable<float>(depth, shape);
    out.depth = std::move(depth);
  }
  if (overlap(out.image, out.alpha) || overlap(out.image, out.depth) || overlap(out.alpha, out.depth))
    refuse(Errc::bad_argument, "two outputs share memory");
  return out;
}

class PyRenderer {
 public:
  PyRenderer(const std::string& device, int threads) {
    begin_work();
    RendererOptions options;
    options.backend = device == "cuda" ? Backend::cuda : device == "cpu" ? Backend::cpu : Backend::automatic;
    options.threads = threads;
    const py::gil_scoped_release unlocked;
    renderer_.emplace(take(Renderer::create(options)));
  }
  PyRenderer(const PyRenderer&) = delete;
  PyRenderer& operator=(const PyRenderer&) = delete;

  const char* device() const { return renderer_->backend() == Backend::cuda ? "cuda" : "cpu"; }
  const char* name() const { return renderer_->backend_name(); }

  // Pictures of one size, one after the other; between them signals are looked at.
  template <class AnyScene>
  py::tuple render(const AnyScene& scene, const std::vector<const Camera*>& cameras, bool batch, py::object image,
                   py::object alpha, py::object depth, bool eight_bit, bool with_alpha, bool with_depth,
                   const RenderOptions& options) {
    begin_work();
    for (const Camera* camera : cameras)
      if (camera == nullptr) refuse(Errc::bad_camera, "None is no camera");
    int width = 0, height = 0;
    if (!cameras.empty()) width = cameras.front()->width, height = cameras.front()->height;
    for (const Camera* camera : cameras) {
      if (camera->width != width || camera->height != height)
        refuse(Errc::bad_argument, "the cameras of one call have pictures of one size: use Camera.resized()",
               camera->name);
    }
    std::vector<py::ssize_t> shape;
    if (batch) shape.push_back(static_cast<py::ssize_t>(cameras.size()));
    shape.push_back(height);
    shape.push_back(width);
    const Outputs out = outputs_of(std::move(shape), std::move(image), std::move(alpha), std::move(depth), eight_bit,
                                   with_alpha, with_depth);
    const std::size_t n_pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    const auto held = drawn(scene);  // a copy: another thread may close the scene
    {
      const py::gil_scoped_release unlocked;
      const std::scoped_lock lock(mutex_);
      stats_.clear();
      if (eight_bit) scratch_.resize(3 * n_pixels);
      for (std::size_t i = 0; i < cameras.size(); ++i) {
        float* const rgb = eight_bit ? scratch_.data() : out.rgb + i * 3 * n_pixels;
        RenderTarget target;
        target.rgb = {rgb, 3 * n_pixels};
        if (out.alpha_data != nullptr) target.alpha = {out.alpha_data + i * n_pixels, n_pixels};
        if (out.depth_data != nullptr) target.depth = {out.depth_data + i * n_pixels, n_pixels};
        stats_.push_back(take(renderer_->render(held, *cameras[i], target, options), name_of(scene)));
        if (eight_bit) std::transform(rgb, rgb + 3 * n_pixels, out.codes + i * 3 * n_pixels, to_8bit);
        check_signals(i + 1 == cameras.size());
      }
    }
    return py::make_tuple(out.image, out.alpha, out.depth);
  }

  // Waits in steps, so that signals are seen. A step that ends early and without success has no room for the view.
  bool refine(const PyStream& stream, const Camera& camera, double seconds, const RenderOptions& options) {
    using Clock = std::chrono::steady_clock;
    constexpr double kStep = 0.1;
    begin_work();
    if (!(seconds >= 0)) refuse(Errc::bad_argument, "seconds to wait are 0 or more");
    const StreamedScene held = stream.scene();
    const py::gil_scoped_release unlocked;
    const std::scoped_lock lock(mutex_);
    const auto since = [](Clock::time_point start) {
      return std::chrono::duration<double>(Clock::now() - start).count();
    };
    const auto start = Clock::now();
    for (;;) {
      const auto step_start = Clock::now();
      const double step = std::min(kStep, std::max(0.0, seconds - since(start)));
      if (take(renderer_->refine(held, camera, step, options), stream.name())) return true;
      if (since(step_start) < step || since(start) >= seconds) return false;
      check_signals(false);
    }
  }

  void prepare(const PyScene& scene) {
    begin_work();
    const Scene held = scene.file.scene;
    const py::gil_scoped_release unlocked;
    const std::scoped_lock lock(mutex_);
    take(renderer_->prepare(held), scene.path);
  }

  py::list stats() {
    std::vector<FrameStats> all;
    {
      const py::gil_scoped_release unlocked;
      const std::scoped_lock lock(mutex_);
      all = stats_;
    }
    py::list list;
    for (const FrameStats& s : all) {
      list.append(py::dict(
          "total_ms"_a = s.total_ms, "project_ms"_a = s.project_ms, "sort_ms"_a = s.sort_ms, "bin_ms"_a = s.bin_ms,
          "blend_ms"_a = s.blend_ms, "gaussians"_a = s.gaussians, "pages"_a = s.pages, "visible"_a = s.visible,
          "instances"_a = s.instances, "evaluated"_a = s.evaluated, "blended"_a = s.blended, "bytes"_a = s.bytes,
          "pages_missing"_a = s.stream.pages_missing, "detail_reached_px"_a = s.stream.detail_reached_px));
    }
    return list;
  }

 private:
  // Raises what a signal's handler raises. Not after the last picture: the interpreter looks itself as soon as it goes on.
  static void check_signals(bool last) {
    if (last) return;
    const py::gil_scoped_acquire locked;
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
  }

  std::mutex mutex_;  // of all below
  std::optional<Renderer> renderer_;
  std::vector<float> scratch_;
  std::vector<FrameStats> stats_;
};

RenderOptions options_of(const std::array<float, 3>& background, std::optional<float> near_plane, float far_plane,
                         int sh_degree, std::optional<float> low_pass, const std::optional<std::string>& anti_aliasing,
                         std::optional<float> detail, const std::string& pipeline) {
  RenderOptions options;
  options.background = background;
  options.near_plane = near_plane.value_or(options.near_plane);
  options.far_plane = far_plane;
  options.sh_degree_limit = sh_degree;
  options.low_pass = low_pass;
  if (anti_aliasing) {
    options.anti_aliasing = *anti_aliasing == "mip" ? math::AntiAliasing::mip_splatting : math::AntiAliasing::classic;
  }
  options.detail_px = detail;
  options.pipeline = pipeline == "baseline" ? Pipeline::baseline
                     : pipeline == "paper"  ? Pipeline::paper
                     : pipeline == "turbo"  ? Pipeline::turbo
                                            : Pipeline::automatic;
  return options;
}

}  // namespace

void bind_render(py::module_& module) {
  py::class_<RenderOptions>(module, "RenderOptions")
      .def(py::init(&options_of), "background"_a, "near_plane"_a, "far_plane"_a, "sh_degree"_a, "low_pass"_a,
           "anti_aliasing"_a, "detail"_a, "pipeline"_a);
  py::class_<PyRenderer>(module, "Renderer")
      .def(py::init<const std::string&, int>(), "device"_a, "threads"_a)
      .def_property_readonly("device", &PyRenderer::device)
      .def_property_readonly("name", &PyRenderer::name)
      .def("render", &PyRenderer::render<PyScene>, "scene"_a, "cameras"_a, "batch"_a, "image"_a, "alpha"_a, "depth"_a,
           "eight_bit"_a, "with_alpha"_a, "with_depth"_a, "options"_a)
      .def("render", &PyRenderer::render<PyStream>, "scene"_a, "cameras"_a, "batch"_a, "image"_a, "alpha"_a, "depth"_a,
           "eight_bit"_a, "with_alpha"_a, "with_depth"_a, "options"_a)
      .def("refine", &PyRenderer::refine, "stream"_a, "camera"_a, "seconds"_a, "options"_a)
      .def("prepare", &PyRenderer::prepare, "scene"_a)
      .def("stats", &PyRenderer::stats);
}

}  // namespace rgs::python
