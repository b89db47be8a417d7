// conformance_files.cpp - see conformance_files.hpp.
// SPDX-License-Identifier: Apache-2.0
#include "conformance_files.hpp"

#include <fmt/format.h>

#include <cmath>
#include <cstddef>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <span>
#include <string_view>
#include <utility>
#include <vector>

#include "conformance.hpp"
#include "console.hpp"
#include "image_file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/ply.hpp"
#include "rgs/renderer.hpp"
#include "scene_file.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr const char* kLicense = R"(The files in this folder are dedicated to the public domain under CC0 1.0 Universal:
https://creativecommons.org/publicdomain/zero/1.0/

Copy, change and use the scenes, cameras, reference pictures and texts for any purpose, without asking and without
naming anybody. This does not cover the programs that made them.
)";

constexpr std::string_view kReadme =
    R"(# Conformance scenes of 3D Gaussian splatting

{0} scenes of a few Gaussians each. Every scene is about one rule of how 3D Gaussian splats become a picture, and a renderer
that breaks the rule shows it in that scene. No program of ours is needed to use them.

| file | content |
|---|---|
| `conformance.json` | all below in one file: what a picture is, the tolerance; for each scene its rule, cameras and probes |
| `NN-NAME/scene.ply` | the Gaussians, with the properties of the original 3DGS code |
| `NN-NAME/cameras.json` | the cameras alone |
| `NN-NAME/CAMERA.exr` | the reference picture of each camera: R, G, B and A in FP32 |

## Testing a renderer

1. Draw every scene of `conformance.json` from each of its cameras, over black, with its near plane and what it declares.
2. Clamp the picture's values and the reference's to 0..1 and compare R, G and B pixel by pixel, and A if the renderer has it. The
   scene passes if no channel differs by more than the tolerance, {1:.6f}: one and a half steps of 8 bits, half a step for
   rounding and one for a Gaussian that falls on the other side of alpha = 1/255.
3. Without a reader for OpenEXR, compare the probes alone, clamped likewise: every wrong rule that we tried changes one of them by
   more than the tolerance.

No pixel comes nearer to a threshold than a ten-thousandth of it, so FP32 arithmetic in any order passes, and so do 8-bit pictures
whose values were rounded once.

## The picture

- A camera is a pinhole. A world point p has the camera coordinates c = W p + t, x right, y down, z forward, and is seen at u = fx
  c.x / c.z + cx, v = fy c.y / c.z + cy, in pixels from the left and upper edges. `world_to_camera` is [W t; 0 1], row by row.
- Pixel (x, y) covers [x, x + 1) x [y, y + 1) and is sampled at its centre. Rows go from top to bottom.
- Scale is exp(scale_*), opacity 1 / (1 + exp(-opacity)); rotation is w, x, y, z and is normalised. `f_rest` holds f_1,
  f_2, ... of red, then of green, then of blue.
- The covariance on the picture is J W R S S R^T W^T J^T (EWA) plus the low-pass on its diagonal: S has the scales on its diagonal, R
  is the rotation, J the Jacobian of (u, v) at the mean. In J the slopes c.x / c.z and c.y / c.z are clamped to 0.3 half pictures
  beyond the picture's edges. If mip-splatting is declared, opacity is multiplied by
  sqrt(max(0.000025, det before / det after)) of the covariance before and after the low-pass.
- Colour is max(0, 1/2 + sum Y_k f_k), f_0 being f_dc, with these Y_k of the unit vector (x, y, z) from the camera to the mean:

      0.28209479
      0.48860251 (-y, z, -x)
      1.09254843 (xy, -yz), 0.31539157 (2zz - xx - yy), 1.09254843 (-xz, (xx - yy) / 2)
      -0.59004359 y (3xx - yy), 2.89061144 xyz, -0.45704580 y (4zz - xx - yy), 0.37317633 z (2zz - 3xx - 3yy),
      -0.45704580 x (4zz - xx - yy), 1.44530572 z (xx - yy), -0.59004359 x (xx - 3yy)

- Gaussians with near < z are blended in the order of z, equal ones in the order of rows: alpha = min(0.99, opacity exp(-d^T C d / 2)),
  with d from the mean to the pixel's centre and C the inverse of the covariance. The transmittance T starts at 1. A Gaussian
  with alpha below 1/255 is skipped; one that would take T (1 - alpha) below 1e-4 ends the pixel without being blended; any
  other adds alpha T times its colour, and T becomes T (1 - alpha).
- Values are display-referred with the encoding of sRGB, blended and stored as they are. EXR holds them without a transfer curve;
  colour is over black, hence premultiplied, and A is 1 - transmittance. Values above 1 are kept.
- What a scene declares is in `conformance.json` and in comments of the PLY: `rgs_axes` where +x, +y, +z point, `rgs_anti_aliasing`,
  `rgs_low_pass_px2`, `rgs_colour_space`. Cameras are in the world whose axes are right, down, forward; means and rotations of a
  file with other axes are taken there, and the direction of Y_k into the file's axes.

## Scenes

| scene | rule |
|---|---|
{2}
Of what is discussed for glTF's KHR_gaussian_splatting (KhronosGroup/glTF, 2490 and 2562), turned Gaussians are scenes 03, 04 and 24,
harmonics term by term 13 to 15, axes 19, sorting 17 and 18, colour space 21. Nodes of a glTF are none of these rules: they move and
turn Gaussians, harmonics too, before there is a picture. No scene has a mesh among its Gaussians.

## Licence

CC0 1.0: see `LICENSE`.
)";

// A step of the work, with the file that it was about.
struct Failure {
  std::string file;
  Error error;
};
template <class T>
using Outcome = tl::expected<T, Failure>;

Outcome<void> write_file(const std::string& path, const std::string& bytes, const AtomicFile::Options& options) {
  auto file = AtomicFile::create(path, options);
  if (!file) return tl::unexpected(Failure{path, file.error()});
  if (const Status written = file->write_at(0, std::as_bytes(std::span(bytes))); !written)
    return tl::unexpected(Failure{path, written.error()});
  if (const auto committed = file->commit(); !committed) return tl::unexpected(Failure{path, committed.error()});
  return {};
}

// Six decimals, as a double.
double decimal(float value) {
  return std::round(double{value} * 1e6) / 1e6;
}

const char* name_of(AaMode mode) {
  return mode == AaMode::mip_splatting ? "mip-splatting" : "classic";
}

// With all declarations, the usual ones too, so that programs of others need no defaults.
std::string ply_file(const MicroScene& scene) {
  const Declarations& d = scene.declared;
  Declarations placed;
  placed.origin = d.origin;
  std::string file = ply_header(scene.gaussians.size(), scene.sh_degree, placed);
  file.insert(file.find("element vertex"),
              fmt::format("comment {}: {}\ncomment rgs_axes: {}\ncomment rgs_colour_space: srgb\n"
                          "comment rgs_anti_aliasing: {}\ncomment rgs_low_pass_px2: {}\n",
                          scene.name, scene.rule, axes_text(d.axes), name_of(d.aa_mode), decimal(d.low_pass_px2)));
  const std::size_t n_header = file.size();
  file.resize(n_header + scene.gaussians.size() * ply_row_bytes(scene.sh_degree, d.origin));
  encode_ply_rows(scene.gaussians, scene.sh_degree, std::as_writable_bytes(std::span(file)).subspan(n_header),
                  d.origin);
  return file;
}

Json cameras_json(const std::vector<Camera>& cameras) {
  Json list = Json::array();
  for (const Camera& camera : cameras) {
    const auto m = row_major(camera.world_to_camera);
    Json rows = Json::array();
    for (std::size_t row = 0; row < 4; ++row)
      rows.push_back({m[4 * row], m[4 * row + 1], m[4 * row + 2], m[4 * row + 3]});
    list.push_back({{"name", camera.name},
                    {"split", "test"},
                    {"width", camera.width},
                    {"height", camera.height},
                    {"fx", camera.fx},
                    {"fy", camera.fy},
                    {"cx", camera.cx},
                    {"cy", camera.cy},
                    {"world_to_camera", std::move(rows)}});
  }
  return list;
}

Result<Image> draw(Renderer& renderer, const Scene& scene, const Camera& camera) {
  Image rgb = Image::make(camera.width, camera.height, 3), alpha = Image::make(camera.width, camera.height, 1);
  RenderTarget target;
  target.rgb = rgb.pixels;
  target.alpha = alpha.pixels;
  RenderOptions options;
  options.near_plane = kMicroNearPlane;
  if (const auto drawn = renderer.render(scene, camera, target, options); !drawn) return tl::unexpected(drawn.error());
  return with_alpha(rgb, alpha.pixels);
}

// Writes a scene's folder and returns its entry in conformance.json.
Outcome<Json> write_scene(Renderer& renderer, const MicroScene& micro, const std::string& folder,
                          const AtomicFile::Options& options) {
  const auto in_folder = [&](const std::string& file) { return (fs::path(folder) / micro.name / file).string(); };
  std::error_code failed;
  if (fs::create_directories(in_folder(""), failed); failed)
    return tl::unexpected(Failure{
        in_folder(""),
        {Errc::write_failed, Error::kNone, "cannot make the folder", Error::kNone, Error::kNone, failed.value()}});
  const std::string ply = in_folder("scene.ply");
  const Json cameras = cameras_json(micro.cameras);
  if (auto written = write_file(ply, ply_file(micro), options); !written) return tl::unexpected(written.error());
  if (auto written = write_file(in_folder("cameras.json"), cameras.dump(1) + "\n", options); !written)
    return tl::unexpected(written.error());
  const auto file = load_scene_file(ply);
  if (!file) return tl::unexpected(Failure{ply, file.error()});

  Json pictures = Json::array();
  std::vector<Image> images;
  for (const Camera& camera : micro.cameras) {
    const std::string path = in_folder(camera.name + ".exr");
    auto image = draw(renderer, file->scene, camera);
    if (!image) return tl::unexpected(Failure{ply, image.error()});
    if (const Status written = write_image(path, *image, {.file = options}); !written)
      return tl::unexpected(Failure{path, written.error()});
    pictures.push_back(camera.name + ".exr");
    images.push_back(*std::move(image));
  }
  Json probes = Json::array();
  for (const MicroProbe& probe : micro.probes) {
    Json rgb = Json::array();
    for (int c = 0; c < 3; ++c) rgb.push_back(decimal(images[probe.camera].at(probe.x, probe.y, c)));
    probes.push_back({{"camera", micro.cameras[probe.camera].name}, {"x", probe.x}, {"y", probe.y}, {"rgb", rgb}});
  }
  const Declarations& d = micro.declared;
  return Json{{"name", micro.name},
              {"folder", micro.name},
              {"rule", micro.rule},
              {"scene", "scene.ply"},
              {"cameras_file", "cameras.json"},
              {"pictures", std::move(pictures)},
              {"gaussians", micro.gaussians.size()},
              {"sh_degree", micro.sh_degree},
              {"axes", axes_text(d.axes)},
              {"colour_space", "srgb"},
              {"anti_aliasing", name_of(d.aa_mode)},
              {"low_pass_px2", decimal(d.low_pass_px2)},
              {"near_plane", decimal(kMicroNearPlane)},
              {"background", {0, 0, 0}},
              {"cameras", cameras},
              {"probes", std::move(probes)}};
}

Json document(Json scenes) {
  return {
      {"version", 1},
      {"picture",
       {{"format", "OpenEXR, FP32; for each camera CAMERA.exr in the scene's folder"},
        {"channels", {"R", "G", "B", "A"}},
        {"rows", "top to bottom"},
        {"colour",
         "display-referred values with the encoding of sRGB, stored as they are, over black (premultiplied); values "
         "above 1 are kept"},
        {"alpha", "1 - transmittance"},
        {"sample", "pixel (x, y) covers [x, x + 1) x [y, y + 1) and is sampled at its centre"}}},
      {"frames",
       {{"world", "scene units; the cameras' world has the axes right, down, forward"},
        {"camera", "x right, y down, z forward; world_to_camera is [R t; 0 1], row by row"},
        {"image", "pixels from the left and upper edges: u = fx x / z + cx, v = fy y / z + cy"}}},
      {"tolerance",
       {{"channel", kMicroTolerance},
        {"rule",
         "after both pictures' values are clamped to 0..1, no channel of any pixel differs by more; probes "
         "likewise"}}},
      {"scenes", std::move(scenes)}};
}

Outcome<void> write_all(const std::string& folder, const AtomicFile::Options& options) {
  if (const Status loaded = load_image_format(ImageFormat::exr); !loaded)
    return tl::unexpected(Failure{"", loaded.error()});
  auto renderer = Renderer::create({.backend = Backend::cpu, .simd = false});
  if (!renderer) return tl::unexpected(Failure{"", renderer.error()});
  const std::vector<MicroScene> micro = micro_scenes();
  Json scenes = Json::array();
  std::string rows;
  for (const MicroScene& m : micro) {
    auto entry = write_scene(*renderer, m, folder, options);
    if (!entry) return tl::unexpected(entry.error());
    scenes.push_back(*std::move(entry));
    rows += fmt::format("| `{}` | {} |\n", m.name, m.rule);
  }
  const auto in_folder = [&](const char* file) { return (fs::path(folder) / file).string(); };
  if (auto written = write_file(in_folder("LICENSE"), kLicense, options); !written) return written;
  const std::string readme = fmt::format(kReadme, micro.size(), kMicroTolerance, rows);
  if (auto written = write_file(in_folder("README.md"), readme, options); !written) return written;
  return write_file(in_folder("conformance.json"), document(std::move(scenes)).dump(1) + "\n", options);
}

}  // namespace

int write_conformance(const std::string& folder, const AtomicFile::Options& options, bool quiet) {
  std::error_code failed;
  const bool is_used =
      fs::exists(folder, failed) && (!fs::is_directory(folder, failed) || !fs::is_empty(folder, failed));
  if (is_used && !options.overwrite)
    return tool::report(folder, {Errc::output_exists, Error::kNone,
                                 "the folder is not empty; name another, or pass --overwrite to replace its files"});
  if (const auto written = write_all(folder, options); !written)
    return tool::report(written.error().file, written.error().error);
  if (!quiet) tool::print(fmt::format("{}: {} scenes\n", tool::printable(folder), micro_scenes().size()));
  return tool::kSuccess;
}

}  // namespace rgs
