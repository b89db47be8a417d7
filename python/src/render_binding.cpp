// render_binding.cpp - draws pictures into arrays that Python holds.
// SPDX-License-Identifier: Apache-2.0
#include <pybind11/stl.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "device_array.hpp"
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
const Scene& drawn(const PyStream& scene) {
  return scene.scene();
}
const std::string& name_of(const PyScene& scene) {
  return scene.path;
}
const std::string& name_of(const PyStream& scene) {
  return scene.name();
}

// An array to fill, and where it is.
struct Output {
  py::object array = py::none();
  std::optional<Elements> memory = {};  // of the host's
  void* data = nullptr;
  std::uint64_t bytes = 0;
};

// The arrays of a call: one picture after the other.
struct Outputs {
  Output image, alpha, depth;
};

// Describes an array; Python has queried device arrays.
struct Description {
  void* data;
  Shape shape;
  bool is_of_type, is_contiguous, is_readonly;
};

void check(const Description& given, const Shape& shape) {
  if (!given.is_of_type) refuse(Errc::bad_argument, "an output has the wrong data type: float32; images may be uint8");
  if (given.shape != shape)
    refuse(Errc::bad_argument,
           "an output has the wrong shape: [height, width, 3] for colour and [height, width] for alpha "
           "and depth, with the number of cameras before that for a list of cameras");
  if (!given.is_contiguous) refuse(Errc::bad_argument, "an output must be C-contiguous");
  if (given.is_readonly) refuse(Errc::bad_argument, "an output is read-only");
}

std::uint64_t bytes_of(const Shape& shape, std::uint64_t element_bytes) {
  for (const py::ssize_t side : shape) element_bytes *= static_cast<std::uint64_t>(side);
  return element_bytes;
}

// `given` is an array to fill; None makes a new one.
template <class T>
Output in_host_memory(py::object given, const Shape& shape) {
  Output out;
  out.array = given.is_none() ? new_array<T>(shape) : std::move(given);
  out.memory.emplace(out.array);
  check({out.memory->data(), out.memory->shape(), out.memory->are<T>(), out.memory->is_contiguous(),
         out.memory->is_readonly()},
        shape);
  out.data = out.memory->data();
  out.bytes = bytes_of(shape, sizeof(T));
  return out;
}

// The same on a device: `given` is (array, address, shape, format, is contiguous, is read-only) or None.
template <class T>
Output in_device_memory(const Renderer& renderer, const py::object& given, const Shape& shape) {
  Output out;
  out.bytes = bytes_of(shape, sizeof(T));
  if (given.is_none()) {
    DeviceArray array{{}, shape, kFormat<T>};
    if (out.bytes > 0) {
      const Unlocked unlocked;
      array.block = take(renderer.allocate_on_device(out.bytes));
    }
    out.data = array.block.data.get();
    out.array = py::cast(std::move(array));
    return out;
  }
  const auto [array, address, sides, format, is_contiguous, is_readonly] =
      given.cast<std::tuple<py::object, std::uintptr_t, Shape, char, bool, bool>>();
  out.data = reinterpret_cast<void*>(address);
  check({out.data, sides, format == kFormat<T>, is_contiguous, is_readonly}, shape);
  out.array = array;
  return out;
}

bool overlap(const Output& a, const Output& b) {
  const auto *first = static_cast<const std::byte*>(a.data), *other = static_cast<const std::byte*>(b.data);
  const std::less<> before;
  return before(first, other + b.bytes) && before(other, first + a.bytes);
}

void refuse_overlap(const Outputs& out) {
  if (overlap(out.image, out.alpha) || overlap(out.image, out.depth) || overlap(out.alpha, out.depth))
    refuse(Errc::bad_argument, "two outputs share memory");
}

// A call's options.
struct Request {
  std::vector<Camera> cameras;  // of one size
  Shape shape;                  // of alpha and depth
  Shape image_shape;
};

Request request_of(const std::vector<const Camera*>& cameras, bool batch) {
  Request request;
  for (const Camera* camera : cameras) {
    if (camera == nullptr) refuse(Errc::bad_camera, "None is no camera");
    if (camera->width != cameras.front()->width || camera->height != cameras.front()->height)
      refuse(Errc::bad_argument, "the cameras of one call must have pictures of one size: use Camera.resized()",
             camera->name);
    request.cameras.push_back(*camera);
  }
  if (batch) request.shape.push_back(static_cast<py::ssize_t>(cameras.size()));
  request.shape.push_back(cameras.empty() ? 0 : cameras.front()->height);
  request.shape.push_back(cameras.empty() ? 0 : cameras.front()->width);
  request.image_shape = request.shape;
  request.image_shape.push_back(3);
  return request;
}

PictureArrays arrays_of(const Outputs& out, bool eight_bit) {
  PictureArrays arrays;
  if (eight_bit) {
    arrays.codes = static_cast<std::uint8_t*>(out.image.data);
  } else {
    arrays.rgb = static_cast<float*>(out.image.data);
  }
  arrays.alpha = static_cast<float*>(out.alpha.data);
  arrays.depth = static_cast<float*>(out.depth.data);
  return arrays;
}

// The arrays from picture i on.
PictureArrays from(PictureArrays p, std::size_t i, std::size_t n_pixels) {
  if (p.rgb != nullptr) p.rgb += 3 * n_pixels * i;
  if (p.codes != nullptr) p.codes += 3 * n_pixels * i;
  if (p.alpha != nullptr) p.alpha += n_pixels * i;
  if (p.depth != nullptr) p.depth += n_pixels * i;
  return p;
}

class PyRenderer {
 public:
  PyRenderer(const std::string& device, int threads) {
    begin_work();
    RendererOptions options;
    options.backend = device == "cuda" ? Backend::cuda : device == "cpu" ? Backend::cpu : Backend::automatic;
    options.threads = threads;
    const Unlocked unlocked;
    renderer_.emplace(take(Renderer::create(options)));
  }
  PyRenderer(const PyRenderer&) = delete;
  PyRenderer& operator=(const PyRenderer&) = delete;

  const char* device() const { return renderer_->backend() == Backend::cuda ? "cuda" : "cpu"; }
  const char* name() const { return renderer_->backend_name(); }

  template <class AnyScene>
  py::tuple render(const AnyScene& scene, const std::vector<const Camera*>& cameras, bool batch, py::object image,
                   py::object alpha, py::object depth, bool eight_bit, bool with_alpha, bool with_depth,
                   const RenderOptions& options) {
    begin_work();
    const Request request = request_of(cameras, batch);
    Outputs out;
    out.image = eight_bit ? in_host_memory<std::uint8_t>(std::move(image), request.image_shape)
                          : in_host_memory<float>(std::move(image), request.image_shape);
    if (with_alpha) out.alpha = in_host_memory<float>(std::move(alpha), request.shape);
    if (with_depth) out.depth = in_host_memory<float>(std::move(depth), request.shape);
    refuse_overlap(out);
    draw(drawn(scene), name_of(scene), request.cameras, arrays_of(out, eight_bit), options);
    return py::make_tuple(out.image.array, out.alpha.array, out.depth.array);
  }

  // The same into device memory, after the work queued on a stream.
  py::tuple render_on_device(const PyScene& scene, const std::vector<const Camera*>& cameras, bool batch,
                             const py::object& image, const py::object& alpha, const py::object& depth, bool eight_bit,
                             bool with_alpha, bool with_depth, std::uintptr_t stream, const RenderOptions& options) {
    begin_work();
    const Request request = request_of(cameras, batch);
    Outputs out;
    out.image = eight_bit ? in_device_memory<std::uint8_t>(*renderer_, image, request.image_shape)
                          : in_device_memory<float>(*renderer_, image, request.image_shape);
    if (with_alpha) out.alpha = in_device_memory<float>(*renderer_, alpha, request.shape);
    if (with_depth) out.depth = in_device_memory<float>(*renderer_, depth, request.shape);
    refuse_overlap(out);
    PictureArrays arrays = arrays_of(out, eight_bit);
    arrays.on_device = true;
    arrays.stream = reinterpret_cast<CUstream_st*>(stream);
    draw(drawn(scene), name_of(scene), request.cameras, arrays, options);
    return py::make_tuple(out.image.array, out.alpha.array, out.depth.array);
  }

  // Waits in steps, so that signals are handled. A step that ends early without success has no room for the view. The scene as in asked().
  bool refine(const PyStream& stream, const Camera& camera, double seconds, const RenderOptions& options) {
    using Clock = std::chrono::steady_clock;
    constexpr double kStep = 0.1;
    begin_work();
    if (!(seconds >= 0)) refuse(Errc::bad_argument, "seconds to wait are 0 or more");
    Scene copy = stream.scene();
    const Unlocked unlocked;
    const Scene held = std::move(copy);
    const std::scoped_lock lock(mutex_);
    const auto since = [](Clock::time_point start) {
      return std::chrono::duration<double>(Clock::now() - start).count();
    };
    const auto start = Clock::now();
    for (;;) {
      const auto step_start = Clock::now();
      const double step = std::min(kStep, std::max(0.0, seconds - since(start)));
      auto refined = renderer_->refine(held, camera, step, options);
      // An error at the end of a step is of a read that is retried.
      const bool is_over = since(step_start) < step || since(start) >= seconds;
      if (is_over || (refined && *refined)) return take(std::move(refined), stream.name());
      check_signals(false);
    }
  }

  void prepare(const PyScene& scene) {
    begin_work();
    const Scene held = scene.file.scene;
    const Unlocked unlocked;
    const std::scoped_lock lock(mutex_);
    take(renderer_->prepare(held), scene.path);
  }

  py::list stats() {
    begin_work();  // another thread may have held the mutex at the fork
    std::vector<FrameStats> all;
    {
      const Unlocked unlocked;
      const std::scoped_lock lock(mutex_);
      all = stats_;
    }
    py::list list;
    for (const FrameStats& s : all) {
      list.append(py::dict("total_ms"_a = s.total_ms, "project_ms"_a = s.project_ms, "sort_ms"_a = s.sort_ms,
                           "bin_ms"_a = s.bin_ms, "blend_ms"_a = s.blend_ms, "gaussians"_a = s.gaussians,
                           "pages"_a = s.pages, "detail_px"_a = s.detail_px, "visible"_a = s.visible,
                           "instances"_a = s.instances, "evaluated"_a = s.evaluated, "blended"_a = s.blended,
                           "bytes"_a = s.bytes, "pages_missing"_a = s.stream.pages_missing,
                           "detail_reached_px"_a = s.stream.detail_reached_px));
    }
    return list;
  }

 private:
  // In parts, with signals handled between them. The scene as in asked().
  void draw(const Scene& scene, const std::string& name, std::span<const Camera> cameras, const PictureArrays& arrays,
            const RenderOptions& options) {
    const bool is_in_parts = renderer_->backend() == Backend::cpu || scene.is_streamed();
    const std::size_t n_pixels = pixels_of(cameras), part = is_in_parts ? 1 : 64;
    Scene copy = scene;
    const Unlocked unlocked;
    const Scene held = std::move(copy);
    const std::scoped_lock lock(mutex_);
    stats_.clear();
    for (std::size_t i = 0; i < cameras.size(); i += part) {
      const auto some = cameras.subspan(i, std::min(part, cameras.size() - i));
      const auto stats = take(renderer_->render_all(held, some, from(arrays, i, n_pixels), options), name);
      stats_.insert(stats_.end(), stats.begin(), stats.end());
      check_signals(i + some.size() == cameras.size());
    }
  }
  static std::size_t pixels_of(std::span<const Camera> cameras) {
    if (cameras.empty()) return 0;
    return static_cast<std::size_t>(cameras.front().width) * static_cast<std::size_t>(cameras.front().height);
  }

  // Raises a signal handler's exception. Not after the last picture, where the interpreter checks by itself.
  static void check_signals(bool last) {
    if (last) return;
    const Locked locked;
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
  }

  std::mutex mutex_;  // of all below
  std::optional<Renderer> renderer_;
  std::vector<FrameStats> stats_;
};

RenderOptions options_of(const std::array<float, 3>& background, std::optional<float> near_plane, float far_plane,
                         int sh_degree, std::optional<float> low_pass, const std::optional<std::string>& anti_aliasing,
                         std::optional<float> detail, std::optional<std::uint64_t> max_gaussians,
                         const std::string& pipeline) {
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
  options.max_gaussians = max_gaussians;
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
           "anti_aliasing"_a, "detail"_a, "max_gaussians"_a, "pipeline"_a);
  py::class_<PyRenderer>(module, "Renderer")
      .def(py::init<const std::string&, int>(), "device"_a, "threads"_a)
      .def_property_readonly("device", &PyRenderer::device)
      .def_property_readonly("name", &PyRenderer::name)
      .def("render", &PyRenderer::render<PyScene>, "scene"_a, "cameras"_a, "batch"_a, "image"_a, "alpha"_a, "depth"_a,
           "eight_bit"_a, "with_alpha"_a, "with_depth"_a, "options"_a)
      .def("render", &PyRenderer::render<PyStream>, "scene"_a, "cameras"_a, "batch"_a, "image"_a, "alpha"_a, "depth"_a,
           "eight_bit"_a, "with_alpha"_a, "with_depth"_a, "options"_a)
      .def("render_on_device", &PyRenderer::render_on_device, "scene"_a, "cameras"_a, "batch"_a, "image"_a, "alpha"_a,
           "depth"_a, "eight_bit"_a, "with_alpha"_a, "with_depth"_a, "stream"_a, "options"_a)
      .def("refine", &PyRenderer::refine, "stream"_a, "camera"_a, "seconds"_a, "options"_a)
      .def("prepare", &PyRenderer::prepare, "scene"_a)
      .def("stats", &PyRenderer::stats);
}

}  // namespace rgs::python
