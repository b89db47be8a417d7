// scene_file.cpp - loads a scene from a splat file of any format.
// SPDX-License-Identifier: Apache-2.0
#include "scene_file.hpp"

#include <utility>

#include "rgs/file.hpp"
#include "rgs/splat_edit.hpp"

namespace rgs {
namespace {

Result<SceneFile> load_rgs(MappedFile file, const DecodeLimits& limits, bool only_open) {
  SceneFile out;
  out.format = SplatFormat::rgs;
  out.file_bytes = file.bytes().size();
  auto scene = only_open ? Scene::open(std::move(file), limits) : Scene::load(std::move(file), limits);
  if (!scene) return tl::unexpected(scene.error());
  out.up = declared_up(*scene->declarations());
  out.scene = std::move(*scene);
  return out;
}

Result<SceneFile> load_other(const std::string& path, const ReadOptions& options, const Axes& axes) {
  auto file = read_splats(path, options);  // in the axes of 3DGS, or undeclared ones
  if (!file) return tl::unexpected(file.error());
  if (axes[0] != Axis::undeclared && file->axes[0] != Axis::undeclared) {
    convert_axes(file->cloud, file->axes, axes);
    convert_axes(file->origin, file->axes, axes);
    convert_axes(file->crs, file->axes, axes);
    file->axes = axes;
  }
  SceneFile out;
  out.format = file->format;
  out.file_bytes = file->bytes;
  auto scene = Scene::load(std::move(file->cloud), declarations_of(*file));
  if (!scene) {
    Error error = scene.error();
    if (error.code == Errc::bad_value) std::swap(error.found, error.offset);  // an index, not a byte offset
    return tl::unexpected(error);
  }
  out.scene = std::move(*scene);
  return out;
}

Result<SceneFile> read_scene_file(const std::string& path, const ReadOptions& options, const Axes& axes,
                                  bool only_open) {
  auto file = MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  if (detect_format(file->bytes()) != SplatFormat::rgs) return load_other(path, options, axes);
  return load_rgs(*std::move(file), options.limits, only_open);
}

}  // namespace

Declarations declarations_of(const SplatFile& file) {
  Declarations d = file.declarations.value_or(Declarations());
  if (d.axes != file.axes) d.first_view = {};  // of means in other axes
  d.axes = file.axes;
  d.colour_space = file.colour_space;
  d.aa_mode = file.aa_mode;
  d.low_pass_px2 = file.low_pass_px2.value_or(default_low_pass_px2(file.aa_mode));
  d.metres_per_unit = file.metres_per_unit;
  d.origin = file.origin;
  d.crs = file.crs;
  return d;
}

Result<SceneFile> load_scene_file(const std::string& path, const ReadOptions& options, const Axes& axes) {
  return read_scene_file(path, options, axes, false);
}

Result<SceneFile> open_scene_file(const std::string& path, const ReadOptions& options) {
  return read_scene_file(path, options, kAxes3dgs, true);
}

}  // namespace rgs
