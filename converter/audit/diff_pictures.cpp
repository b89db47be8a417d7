// diff_pictures.cpp - pictures of two files by the same cameras, and where they differ.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <filesystem>
#include <string>
#include <system_error>

#include "audit_picture.hpp"
#include "audit_render.hpp"
#include "audit_scenes.hpp"
#include "audit_views.hpp"
#include "camera_choice.hpp"
#include "diff.hpp"
#include "image_file.hpp"
#include "rgs/renderer.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs::audit {
namespace {

Result<Image> drawn(Renderer& renderer, const Source& source, const Scene& scene, const Camera& camera) {
  Image image = Image::make(camera.width, camera.height, 3);
  const auto stats = renderer.render(scene, camera, {.rgb = image.pixels}, reference_arithmetic(source.declarations()));
  if (!stats) return tl::unexpected(stats.error());
  return image;
}

constexpr std::array kKinds{"a", "b", "difference"};

std::vector<std::string> paths_of(const std::string& folder, const std::vector<View>& views) {
  std::vector<Camera> cameras;
  cameras.reserve(views.size());
  for (const View& view : views) cameras.push_back(view.camera);
  return picture_paths(folder, cameras, kKinds);
}

}  // namespace

Outcome<std::vector<std::string>> difference_paths(const std::string& folder, const Options& options) {
  const auto views = choose_views(options, {}, kNoOrigin);
  if (!views) return tl::unexpected(views.error());
  return paths_of(folder, *views);
}

Outcome<std::vector<DiffView>> draw_differences(const std::string& folder, const Sides& sides, const Options& options,
                                                bool overwrite) {
  const auto views = choose_views(options, {}, kNoOrigin);
  if (!views) return tl::unexpected(views.error());
  std::error_code failed;
  std::filesystem::create_directories(detail::path_of(folder), failed);
  if (failed)
    return make_error(folder, {Errc::write_failed, Error::kNone, "cannot make the folder", Error::kNone, Error::kNone,
                               failed.value()});
  const auto a = source_scene(sides.a), b = source_scene(sides.b);
  for (const auto* scene : {&a, &b})
    if (!*scene) return make_error(folder, scene->error());
  auto renderer = Renderer::create({.backend = options.backend, .threads = options.threads});
  if (!renderer) return make_error(folder, renderer.error());
  const std::vector<std::string> paths = paths_of(folder, *views);
  ImageFileOptions file;
  file.file.overwrite = overwrite;
  std::vector<DiffView> found;
  for (std::size_t i = 0; i < views->size(); ++i) {
    const Camera& camera = (*views)[i].camera;
    const auto of_a = drawn(*renderer, sides.a, a->scene, camera), of_b = drawn(*renderer, sides.b, b->scene, camera);
    for (const auto* image : {&of_a, &of_b})
      if (!*image) return make_error(folder, image->error());
    const auto difference = rgs::difference(*of_a, *of_b);
    if (!difference) return make_error(folder, difference.error());
    const Image levels = difference_levels({*of_a, *of_a}, {*of_b, *of_b});
    const Image map = heat_map(levels, scale_top({&levels, 1}));
    const std::array<const Image*, kKinds.size()> pictures{&*of_a, &*of_b, &map};
    for (std::size_t k = 0; k < kKinds.size(); ++k) {
      const std::string& path = paths[i * kKinds.size() + k];
      if (const Status ok = write_image(path, *pictures[k], file); !ok) return make_error(path, ok.error());
    }
    found.push_back({camera.name, difference->psnr, difference->largest});
  }
  return found;
}

}  // namespace rgs::audit
