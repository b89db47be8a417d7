// scene_binding.cpp - scenes from files, addresses and arrays; saving; info().
// SPDX-License-Identifier: Apache-2.0
#include "scene_binding.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <optional>
#include <span>
#include <stop_token>
#include <string>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "camera_binding.hpp"
#include "convert.hpp"
#include "info_json.hpp"
#include "info_report.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/interchange.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"
#include "rgs/splat_edit.hpp"
#include "work.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace rgs::python {
namespace {

Axes spz_axes_named(const std::string& name) {
  return name == "opengl" ? kAxesOpenGl : kAxes3dgs;
}

struct LoadOptions {
  ReadOptions read;
  bool has_choice() const { return read.level_of_detail || read.max_count; }
};

// Gaussians from a file other than .rgs, in the frame in which scenes are drawn.
Result<SceneFile> scene_of(Result<SplatFile> file) {
  if (!file) return tl::unexpected(file.error());
  SceneFile out;
  out.format = file->format;
  out.file_bytes = file->bytes;
  if (file->declarations) out.up = declared_up(*file->declarations);
  auto scene = Scene::load(std::move(file->cloud), declarations_of(*file));
  if (!scene) {
    Error error = scene.error();
    if (error.code == Errc::bad_value) std::swap(error.found, error.offset);  // an index, not a byte of the file
    return tl::unexpected(error);
  }
  out.scene = *std::move(scene);
  return out;
}

Result<SceneFile> load_path(const std::string& path, const LoadOptions& options) {
  if (!options.has_choice()) return load_scene_file(path, options.read);
  return scene_of(read_splats(path, options.read));
}

Result<SceneFile> load_url(ByteSource& source, const LoadOptions& options, Progress& progress) {
  constexpr std::uint64_t kPart = std::uint64_t{1} << 20;
  if (source.size() > options.read.limits.max_file_bytes)
    return make_error(Errc::limit_exceeded, Error::kNone, "the file is larger than the limit",
                      options.read.limits.max_file_bytes, source.size());
  std::vector<std::byte> bytes(source.size());
  progress.begin("read", bytes.size(), "B");
  for (std::uint64_t first = 0; first < bytes.size(); first += kPart) {
    const auto part = std::span(bytes).subspan(first, std::min<std::uint64_t>(kPart, bytes.size() - first));
    if (const Status s = source.read(first, part); !s) return tl::unexpected(s.error());
    progress.advance(part.size());
  }
  if (detect_format(bytes) != SplatFormat::rgs || options.has_choice())
    return scene_of(read_splats(bytes, options.read));
  auto scene = Scene::load(bytes, options.read.limits);
  if (!scene) return tl::unexpected(scene.error());
  SceneFile out;
  out.format = SplatFormat::rgs;
  out.file_bytes = bytes.size();
  out.up = declared_up(*scene->declarations());
  out.scene = *std::move(scene);
  return out;
}

PyScene load(const std::string& name, std::optional<std::uint32_t> level_of_detail,
             std::optional<std::uint64_t> max_count, std::optional<std::uint64_t> max_expansion,
             const std::string& spz_axes, py::object callback) {
  LoadOptions options;
  options.read.spz_axes = spz_axes_named(spz_axes);
  options.read.level_of_detail = level_of_detail;
  options.read.max_count = max_count;
  if (max_expansion) options.read.limits.max_expansion = *max_expansion;
  const auto progress = std::make_shared<Progress>(std::move(callback));
  if (!is_url(name)) return {take(run([=] { return load_path(name, options); }, progress, {}), name), name};
  const std::stop_source stop;
  const auto work = [=]() -> Result<SceneFile> {
    return detail::guard_memory([&]() -> Result<SceneFile> {
      UrlOptions way;
      way.stop = stop.get_token();
      const auto source = open_url_source(name, way);
      if (!source) return tl::unexpected(source.error());
      return load_url(**source, options, *progress);
    });
  };
  return {take(run_stoppable(work, progress, stop), name), name};
}

// ---- arrays

// float32, C-contiguous, shapes that agree: means [n, 3], quats [n, 4], scales [n, 3], opacities [n],
// sh [n, k, 3].
PyScene from_arrays(const py::object& means, const py::object& quats, const py::object& scales,
                    const py::object& opacities, const py::object& sh, int sh_degree, const Origin& origin,
                    const std::string& anti_aliasing, std::optional<float> low_pass) {
  begin_work();
  const Elements mean(means), rotation(quats), scale(scales), opacity(opacities), harmonics(sh);
  SceneView view;
  view.mean = mean.as<float>();
  view.rotation = rotation.as<float>();
  view.scale = scale.as<float>();
  view.opacity = opacity.as<float>();
  view.sh = harmonics.as<float>();
  view.n = view.opacity.size();
  view.sh_degree = sh_degree;
  Declarations declared;
  declared.origin = origin;
  declared.aa_mode = anti_aliasing == "mip" ? AaMode::mip_splatting : AaMode::classic;
  declared.low_pass_px2 = low_pass.value_or(default_low_pass_px2(declared.aa_mode));
  PyScene out;
  const Unlocked unlocked;
  out.file.scene = take(Scene::load(view, declared));
  return out;
}

SceneView view_of(const PyScene& scene) {
  begin_work();
  const Unlocked unlocked;
  return take(scene.file.scene.view(), scene.path);
}

SceneBounds bounds_of(const PyScene& scene) {
  const Unlocked unlocked;
  return take(subject_bounds(scene.file.scene), scene.path);
}

// A read-only array that keeps the scene's memory alive: a row of each Gaussian's `stride` numbers.
py::object array_of(const PyScene& scene, const float* data, Shape row, py::ssize_t stride) {
  static const float nothing = 0;
  Shape shape{static_cast<py::ssize_t>(scene.file.scene.size())};
  shape.insert(shape.end(), row.begin(), row.end());
  Shape strides(shape.size());
  py::ssize_t step = sizeof(float);
  for (std::size_t i = row.size(); i > 0; --i) {
    strides[i] = step;
    step *= row[i - 1];
  }
  strides[0] = stride * static_cast<py::ssize_t>(sizeof(float));
  const py::capsule owner(new Scene(scene.file.scene), [](void* p) { delete static_cast<Scene*>(p); });
  return readonly_array(owner, data == nullptr ? &nothing : data, std::move(shape), std::move(strides));
}

py::object sh_of(const PyScene& scene, int first, int end) {
  const SceneView view = view_of(scene);
  const int all = sh_coefficients(view.sh_degree);
  return array_of(scene, view.sh.data() + (view.n == 0 ? 0 : 3 * first), {std::min(end, all) - first, 3}, 3 * all);
}

// ---- saving

// The scene in training parameters. Values from a file encode to the same codes again.
Result<SplatCloud> cloud_of(const Scene& scene) {
  SplatCloud cloud;
  cloud.resize(scene.size(), scene.sh_degree());
  if (scene.has_file()) {
    FileView file = *scene.file();
    if (const Status s = file.preload(); !s) return tl::unexpected(s.error());
    std::array<Splat, 256> rows;
    for (std::uint64_t first = 0; first < scene.size(); first += rows.size()) {
      const auto part = std::span(rows).first(std::min<std::uint64_t>(rows.size(), scene.size() - first));
      if (const Status s = file.read(first, part); !s) return tl::unexpected(s.error());
      for (std::size_t i = 0; i < part.size(); ++i) cloud.set(first + i, part[i]);
    }
    return cloud;
  }
  const auto view = scene.view();
  if (!view) return tl::unexpected(view.error());
  float largest = 0;
  for (const float scale : view->scale) largest = std::max(largest, scale);
  int exponent = 0;  // relative to the largest scale, so that a scale of 0 is far below all stored ones
  (void)std::frexp(largest, &exponent);
  cloud.mean.assign(view->mean.begin(), view->mean.end());
  cloud.rotation.assign(view->rotation.begin(), view->rotation.end());
  cloud.sh.assign(view->sh.begin(), view->sh.end());
  std::ranges::transform(view->scale, cloud.log_scale.begin(),
                         [&](float scale) { return log_from_scale(scale, std::clamp(14 - exponent, -110, 110)); });
  std::ranges::transform(view->opacity, cloud.opacity_logit.begin(), logit_from_opacity);
  return cloud;
}

struct SaveOptions {
  SplatFormat format = SplatFormat::rgs;
  Axes spz_axes = kAxes3dgs;
  ConvertOptions convert;
};

Result<ConvertSummary> save_scene(const Scene& scene, const std::string& path, SaveOptions options,
                                  const StageObserver& observer) {
  return detail::guard_memory([&]() -> Result<ConvertSummary> {
    auto cloud = cloud_of(scene);
    if (!cloud) return tl::unexpected(cloud.error());
    EncodeOptions& encode = options.convert.encode;
    if (scene.declarations()) encode = keep_declarations(std::move(encode), *scene.declarations());
    // A scene from arrays has no depth range of its own.
    if (scene.file() == nullptr && scene.levels() == nullptr) encode.depth.reset();
    // The file's chunks keep their steps, and so their SH codes.
    if (scene.has_file()) {
      encode.chunk_size = scene.file()->header().chunk_size;
      encode.chunk_step_sets = scene.file()->header().n_step_sets == scene.file()->header().n_chunks;
    }
    encode.n_source = 0;
    encode.n_repaired = 0;
    Origin origin = scene.origin();
    if (options.format != SplatFormat::rgs && encode.axes[0] != Axis::undeclared) {
      const Axes axes = options.format == SplatFormat::spz ? options.spz_axes : format_info(options.format).axes;
      convert_axes(*cloud, encode.axes, axes);
      convert_axes(origin, encode.axes, axes);
      convert_axes(encode.crs, encode.axes, axes);
      encode.axes = axes;
    }
    LoadedScene loaded;
    loaded.n_source = cloud->size();
    loaded.source_sh_degree = cloud->sh_degree;
    loaded.cloud = *std::move(cloud);
    loaded.origin = origin;
    return convert_scene(std::move(loaded), options.format, path, options.convert, observer);
  });
}

// Returns the bytes written.
std::uint64_t save(const PyScene& scene, const std::string& path, const std::string& profile, const std::string& lod,
                   bool overwrite, bool sync, bool strict, const std::string& spz_axes, py::object callback) {
  SaveOptions options;
  options.format = format_of_name(path);
  options.spz_axes = spz_axes_named(spz_axes);
  static const std::string endings = "the ending names the format: " + format_list(true);
  if (options.format == SplatFormat::unknown) refuse(Errc::bad_argument, endings.c_str(), path);
  if (!format_info(options.format).writable) refuse(Errc::bad_argument, "this format is read only", path);
  if (options.format != SplatFormat::rgs && (profile != "packed" || !lod.empty()))
    refuse(Errc::bad_argument, "profile= and lod= are for .rgs outputs", path);
  EncodeOptions& encode = options.convert.encode;
  encode.profile = profile == "direct" ? Profile::direct : profile == "packed" ? Profile::packed : Profile::archive;
  encode.archive = profile == "archive:tiny"    ? archive_tiny()
                   : profile == "archive:small" ? archive_small()
                                                : archive_high();
  if (!lod.empty()) options.convert.levels = lod == "best" ? lod::Quality::best : lod::Quality::fast;
  options.convert.strict = strict;
  options.convert.output = {.overwrite = overwrite, .sync = sync};
  const std::string folder = path.substr(0, path.find_last_of('/') + 1);
  options.convert.scratch = folder.empty() ? "." : folder;
  const auto progress = std::make_shared<Progress>(std::move(callback));
  const Scene held = scene.file.scene;
  const auto work = [held, path, options, progress]() -> Result<ConvertSummary> {
    try {
      return save_scene(held, path, options, progress->observer());
    } catch (const Cancelled&) {
      return make_error(Errc::cancelled, Error::kNone, "given up");
    }
  };
  return take(run(work, progress, [progress] { progress->cancel(); }), path).output_bytes;
}

// ---- what a file holds

std::string info(const std::string& path, bool verify, std::optional<bool> statistics,
                 std::optional<std::uint64_t> max_expansion) {
  tool::InfoOptions options;
  options.verify = verify;
  options.statistics = statistics;
  if (max_expansion) options.limits.max_expansion = *max_expansion;
  struct Outcome {
    std::string json;
    std::optional<Error> error;
  };
  const auto work = [=]() -> Result<Outcome> {
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    const tool::InfoReport report = tool::inspect(path, file->bytes(), options);
    if (const Status s = file->check_unchanged(); !s) return tl::unexpected(s.error());
    return Outcome{tool::info_json(report), report.error};
  };
  Outcome outcome = take(run(work, nullptr, {}), path);
  // The report says what a truncated file with levels lacks.
  if (outcome.error && outcome.error->code != Errc::pages_missing) throw Failure{*outcome.error, path};
  return outcome.json;
}

py::object format_of(const PyScene& scene) {
  if (scene.file.format == SplatFormat::unknown) return py::none();
  return py::str(format_name(scene.file.format));
}

}  // namespace

void bind_scene(py::module_& module) {
  py::class_<PyScene>(module, "Scene")
      .def_static("from_arrays", &from_arrays, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a,
                  "origin"_a, "anti_aliasing"_a, "low_pass"_a)
      .def_property_readonly("path", [](const PyScene& s) { return py::bytes(s.path); })
      .def_property_readonly("format", &format_of)
      .def_property_readonly("file_bytes", [](const PyScene& s) { return s.file.file_bytes; })
      .def_property_readonly("n", [](const PyScene& s) { return s.file.scene.size(); })
      .def_property_readonly("sh_degree", [](const PyScene& s) { return s.file.scene.sh_degree(); })
      .def_property_readonly("origin", [](const PyScene& s) { return s.file.scene.origin(); })
      .def_property_readonly("crs",
                             [](const PyScene& s) {
                               const auto& declared = s.file.scene.declarations();
                               return declared ? declared->crs.text : std::string();
                             })
      .def_property_readonly("memory_bytes", [](const PyScene& s) { return s.file.scene.bytes(); })
      .def_property_readonly("n_levels",
                             [](const PyScene& s) -> std::uint32_t {
                               const PagedFile* levels = s.file.scene.levels();
                               if (levels == nullptr) return 0;
                               std::uint32_t n = 0;
                               for (const lod::Page& page : levels->pages()) n = std::max(n, page.level + 1U);
                               return n;
                             })
      .def_property_readonly("anti_aliasing",
                             [](const PyScene& s) {
                               const auto& declared = s.file.scene.declarations();
                               return declared && declared->aa_mode == AaMode::mip_splatting ? "mip" : "classic";
                             })
      .def_property_readonly("low_pass",
                             [](const PyScene& s) {
                               const auto& declared = s.file.scene.declarations();
                               return declared ? declared->low_pass_px2 : default_low_pass_px2(AaMode::classic);
                             })
      .def_property_readonly("bounds",
                             [](const PyScene& s) {
                               begin_work();
                               const auto [low, high] = bounds_of(s);
                               return py::make_tuple(py::make_tuple(low.x, low.y, low.z),
                                                     py::make_tuple(high.x, high.y, high.z));
                             })
      .def_property_readonly("first_view",
                             [](const PyScene& s) {
                               begin_work();
                               const Scene& scene = s.file.scene;
                               const Unlocked unlocked;
                               return PlacedView{take(first_view(scene, s.file.up), s.path), scene.origin()};
                             })
      .def_property_readonly("up",
                             [](const PyScene& s) { return py::make_tuple(s.file.up.x, s.file.up.y, s.file.up.z); })
      .def_property_readonly("means", [](const PyScene& s) { return array_of(s, view_of(s).mean.data(), {3}, 3); })
      .def_property_readonly("quats", [](const PyScene& s) { return array_of(s, view_of(s).rotation.data(), {4}, 4); })
      .def_property_readonly("scales", [](const PyScene& s) { return array_of(s, view_of(s).scale.data(), {3}, 3); })
      .def_property_readonly("opacities",
                             [](const PyScene& s) { return array_of(s, view_of(s).opacity.data(), {}, 1); })
      .def_property_readonly("sh", [](const PyScene& s) { return sh_of(s, 0, 16); })
      .def_property_readonly("sh0", [](const PyScene& s) { return sh_of(s, 0, 1); })
      .def_property_readonly("shN", [](const PyScene& s) { return sh_of(s, 1, 16); })
      .def("save", &save, "path"_a, "profile"_a, "lod"_a, "overwrite"_a, "sync"_a, "strict"_a, "spz_axes"_a,
           "progress"_a);
  module.def("load", &load, "name"_a, "level_of_detail"_a, "max_count"_a, "max_expansion"_a, "spz_axes"_a,
             "progress"_a);
  module.def("info", &info, "path"_a, "verify"_a, "statistics"_a, "max_expansion"_a);
}

}  // namespace rgs::python
