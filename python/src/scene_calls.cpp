// scene_calls.cpp - scenes from files, addresses and arrays; saving; info().
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "calls.hpp"
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
#include "scene_file.hpp"
#include "work.hpp"

namespace rgs::python {
namespace {

struct HeldScene {
  std::mutex mutex;  // of the following
  std::optional<Scene> scene;
};
using SceneHandle = std::shared_ptr<HeldScene>;

Axes spz_axes_of(const Json& a) {
  return a.at("spz_axes") == "opengl" ? kAxesOpenGl : kAxes3dgs;
}

bool has_choice(const ReadOptions& options) {
  return options.level_of_detail || options.max_count;
}

// Gaussians from a file other than .rgs, in the frame in which scenes are drawn.
Result<SceneFile> prepared(Result<SplatFile> file) {
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

Result<SceneFile> load_path(const std::string& path, const ReadOptions& options) {
  if (!has_choice(options)) return load_scene_file(path, options);
  return prepared(read_splats(path, options));
}

Result<SceneFile> load_url(ByteSource& source, const ReadOptions& options, Work& work) {
  constexpr std::uint64_t kPart = std::uint64_t{1} << 20;
  if (source.size() > options.limits.max_file_bytes)
    return make_error(Errc::limit_exceeded, Error::kNone, "the file is larger than the limit",
                      options.limits.max_file_bytes, source.size());
  std::vector<std::byte> bytes(source.size());
  work.begin("read", bytes.size(), "B");
  for (std::uint64_t first = 0; first < bytes.size(); first += kPart) {
    const auto part = std::span(bytes).subspan(first, std::min<std::uint64_t>(kPart, bytes.size() - first));
    if (const Status s = source.read(first, part); !s) return tl::unexpected(s.error());
    work.advance(part.size());
  }
  if (detect_format(bytes) != SplatFormat::rgs || has_choice(options)) return prepared(read_splats(bytes, options));
  auto scene = Scene::load(bytes, options.limits);
  if (!scene) return tl::unexpected(scene.error());
  SceneFile out;
  out.format = SplatFormat::rgs;
  out.file_bytes = bytes.size();
  out.up = declared_up(*scene->declarations());
  out.scene = *std::move(scene);
  return out;
}

// What a scene says of itself.
Json facts_of(const Scene& scene) {
  const auto& declared = scene.declarations();
  std::uint32_t n_levels = 0;
  if (const PagedFile* levels = scene.levels())
    for (const lod::Page& page : levels->pages()) n_levels = std::max(n_levels, page.level + 1U);
  return {{"n", scene.size()},
          {"sh_degree", scene.sh_degree()},
          {"origin", scene.origin()},
          {"crs", declared ? declared->crs.text : std::string()},
          {"anti_aliasing", declared && declared->aa_mode == AaMode::mip_splatting ? "mip" : "classic"},
          {"low_pass", declared ? declared->low_pass_px2 : default_low_pass_px2(AaMode::classic)},
          {"levels", n_levels},
          {"up", numbers(declared ? declared_up(*declared) : kWorldUp)}};
}

Json facts(const Json& a) {
  return facts_of(scene_of(a));
}

Json load(const Json& a) {
  const std::string name = path_of(a);
  ReadOptions options;
  options.spz_axes = spz_axes_of(a);
  options.level_of_detail = optional<std::uint32_t>(a, "level_of_detail");
  options.max_count = optional<std::uint64_t>(a, "max_count");
  if (const auto ratio = optional<std::uint64_t>(a, "max_expansion")) options.limits.max_expansion = *ratio;
  Work& work = *held<std::shared_ptr<Work>>(a, "work");
  auto file = take([&]() -> Result<SceneFile> {
    if (!is_url(name)) return load_path(name, options);
    return detail::guard_memory([&]() -> Result<SceneFile> {
      UrlOptions way;
      way.stop = work.stop();
      const auto source = open_url_source(name, way);
      if (!source) return tl::unexpected(source.error());
      return load_url(**source, options, work);
    });
  }());
  Json out = facts_of(file.scene);
  out["up"] = numbers(file.up);
  out["format"] = file.format == SplatFormat::unknown ? Json() : Json(format_name(file.format));
  give_scene(a, std::move(file.scene));
  return out;
}

// ---- arrays

// Addresses of FP32 arrays: means [n, 3], quats [n, 4], scales [n, 3], opacities [n], sh [n, k, 3].
Json scene_of_arrays(const Json& a) {
  SceneView view;
  view.n = a.at("n");
  view.sh_degree = a.at("sh_degree");
  const auto floats = [&](const char* name, std::size_t row) {
    return std::span(address<const float>(a, name), view.n * row);
  };
  view.mean = floats("means", 3);
  view.rotation = floats("quats", 4);
  view.scale = floats("scales", 3);
  view.opacity = floats("opacities", 1);
  view.sh = floats("sh", 3 * static_cast<std::size_t>(sh_coefficients(view.sh_degree)));
  Declarations declared;
  declared.origin = a.at("origin");
  declared.aa_mode = a.at("anti_aliasing") == "mip" ? AaMode::mip_splatting : AaMode::classic;
  declared.low_pass_px2 = optional<float>(a, "low_pass").value_or(default_low_pass_px2(declared.aa_mode));
  return give_scene(a, take(Scene::load(view, declared)));
}

// The addresses of a scene's arrays.
Json arrays(const Json& a) {
  const SceneView view = take(scene_of(a).view());
  const auto at = [](std::span<const float> values) { return reinterpret_cast<std::uintptr_t>(values.data()); };
  return {{"means", at(view.mean)},
          {"quats", at(view.rotation)},
          {"scales", at(view.scale)},
          {"opacities", at(view.opacity)},
          {"sh", at(view.sh)}};
}

Json bounds(const Json& a) {
  const auto [low, high] = take(subject_bounds(scene_of(a)));
  return {numbers(low), numbers(high)};
}

// Ends the scene, or leaves that to the calls that use it now.
Json close(const Json& a) {
  HeldScene& closed = *held<SceneHandle>(a, "scene");
  std::optional<Scene> last;  // ends without the lock
  const std::scoped_lock lock(closed.mutex);
  last.swap(closed.scene);
  return nullptr;
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
Json save(const Json& a) {
  const std::string path = path_of(a), profile = a.at("profile"), lod = a.at("lod");
  SaveOptions options;
  options.format = format_of_name(path);
  options.spz_axes = spz_axes_of(a);
  static const std::string endings = "the ending names the format: " + format_list(true);
  if (options.format == SplatFormat::unknown) refuse(Errc::bad_argument, endings.c_str());
  if (!format_info(options.format).writable) refuse(Errc::bad_argument, "this format is read only");
  if (options.format != SplatFormat::rgs && (profile != "packed" || !lod.empty()))
    refuse(Errc::bad_argument, "profile= and lod= are for .rgs outputs");
  EncodeOptions& encode = options.convert.encode;
  encode.profile = profile == "direct" ? Profile::direct : profile == "packed" ? Profile::packed : Profile::archive;
  encode.archive = profile == "archive:tiny"    ? archive_tiny()
                   : profile == "archive:small" ? archive_small()
                                                : archive_high();
  if (!lod.empty()) options.convert.levels = lod == "best" ? lod::Quality::best : lod::Quality::fast;
  options.convert.strict = a.at("strict");
  options.convert.output = {.overwrite = a.at("overwrite"), .sync = a.at("sync")};
  const std::string folder = path.substr(0, path.find_last_of('/') + 1);
  options.convert.scratch = folder.empty() ? "." : folder;
  return take(save_scene(scene_of(a), path, options, held<std::shared_ptr<Work>>(a, "work")->observer())).output_bytes;
}

// ---- what a file holds

// The report of rgs-info --json, as text. It says what a truncated file with levels lacks.
Json info(const Json& a) {
  const std::string path = path_of(a);
  tool::InfoOptions options;
  options.verify = a.at("verify");
  options.statistics = optional<bool>(a, "statistics");
  if (const auto ratio = optional<std::uint64_t>(a, "max_expansion")) options.limits.max_expansion = *ratio;
  const auto file = take(MappedFile::open(path));
  const tool::InfoReport report = tool::inspect(path, file.bytes(), options);
  take(file.check_unchanged());
  if (report.error && report.error->code != Errc::pages_missing) throw Failure{*report.error};
  return tool::info_json(report);
}

// ---- long calls

Json make_work(const Json& a) {
  return give(a, std::make_shared<Work>());
}
Json report(const Json& a) {
  return held<std::shared_ptr<Work>>(a, "work")->report();
}
Json cancel(const Json& a) {
  held<std::shared_ptr<Work>>(a, "work")->cancel();
  return nullptr;
}

}  // namespace

Scene scene_of(const Json& a) {
  HeldScene& scene = *held<SceneHandle>(a, "scene");
  const std::scoped_lock lock(scene.mutex);
  if (!scene.scene) refuse(Errc::bad_argument, "the scene is closed");
  return *scene.scene;
}

Json give_scene(const Json& a, Scene scene) {
  const auto handle = std::make_shared<HeldScene>();
  handle->scene = std::move(scene);
  return give(a, handle);
}

Calls scene_calls() {
  return {{"load", load},     {"facts", facts},         {"scene_of_arrays", scene_of_arrays},
          {"arrays", arrays}, {"bounds", bounds},       {"save", save},
          {"info", info},     {"make_work", make_work}, {"report", report},
          {"cancel", cancel}, {"close", close}};
}

}  // namespace rgs::python
