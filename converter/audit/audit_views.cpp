// audit_views.cpp - chooses cameras by split, and photographs by name.
// SPDX-License-Identifier: Apache-2.0
#include "audit_views.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <utility>

#include "image_file.hpp"
#include "photo_folder.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs::audit {
namespace {

namespace fs = std::filesystem;

constexpr std::size_t kAllOfFew = 32;  // with more cameras than this, the test cameras alone are used
constexpr std::size_t kNamed = 8;      // names in an error; the rest are counted

// "a, b, c and 5 more".
std::string listed(const std::vector<std::string>& names) {
  std::string text;
  for (std::size_t i = 0; i < std::min(kNamed, names.size()); ++i) text += (i == 0 ? "" : ", ") + names[i];
  if (names.size() > kNamed) text += fmt::format(" and {} more", names.size() - kNamed);
  return text;
}

Outcome<std::vector<Camera>> cameras_of(const Options& options) {
  const auto set = read_camera_set(options.cameras);
  if (!set) return make_error(options.cameras, set.error());
  const std::string split = !options.split.empty()                              ? options.split
                            : !options.video && set->cameras.size() > kAllOfFew ? "test"
                                                                                : "all";
  std::vector<Camera> chosen;
  for (std::size_t i = 0; i < set->cameras.size(); ++i)
    if (split == "all" || (set->split[i] == Split::test) == (split == "test")) chosen.push_back(set->cameras[i]);
  if (chosen.empty())
    return make_error(options.cameras, {Errc::bad_argument, Error::kNone, "no camera is in the split of --split"});
  return chosen;
}

// Assigns each view its photograph. One error names all that are missing, one all of another size.
Outcome<std::vector<View>> with_photos(std::vector<View> views, const Options& options) {
  const auto photos = PhotoFolder::open(options.photos);
  if (!photos) return make_error(options.photos, photos.error());
  std::vector<std::string> missing, different;
  for (View& view : views) {
    view.photo = photos->find(view.camera.name);
    if (view.photo.empty()) {
      missing.push_back(view.camera.name.empty() ? "a camera without a name" : view.camera.name);
      continue;
    }
    const auto extent = read_image_extent(view.photo);
    if (!extent) return make_error(view.photo, extent.error());
    if (extent->width != view.camera.width || extent->height != view.camera.height)
      different.push_back(fmt::format("{} ({}x{}, its camera {}x{})", detail::path_of(view.photo).filename().string(),
                                      extent->width, extent->height, view.camera.width, view.camera.height));
  }
  if (!missing.empty())
    return make_error(
        fmt::format("{}: {}", options.photos, listed(missing)),
        {Errc::bad_argument, Error::kNone, "cameras without a photograph of their name (--split chooses cameras)",
         views.size(), views.size() - missing.size()});
  if (!different.empty())
    return make_error(fmt::format("{}: {}", options.photos, listed(different)),
                      {Errc::bad_argument, Error::kNone,
                       "photographs differ in size from their cameras; scale them to match (undistorted photographs "
                       "need undistorted cameras)"});
  return views;
}

}  // namespace

ViewFormat view_format(const Options& options) {
  ViewFormat format;
  if (options.size.width > 0) format.width = options.size.width, format.height = options.size.height;
  return format;
}

Outcome<std::vector<View>> choose_views(const Options& options, const FirstView& first, const Origin& origin) {
  std::vector<Camera> cameras;
  if (options.cameras.empty()) {
    cameras = orbit(first, origin, options.views, view_format(options));
    for (std::size_t i = 0; i < cameras.size(); ++i)
      cameras[i].name = fmt::format("orbit {:.0f} degrees", 360.0 * static_cast<double>(i) / options.views);
  } else {
    auto chosen = cameras_of(options);
    if (!chosen) return tl::unexpected(chosen.error());
    cameras = std::move(*chosen);
  }
  std::vector<View> views;
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    const bool resize = !options.cameras.empty() && options.size.width > 0;
    views.push_back({resize ? resized(cameras[i], options.size.width, options.size.height) : cameras[i], {}});
  }
  const auto differs = [&](const View& v) {
    return v.camera.width != views[0].camera.width || v.camera.height != views[0].camera.height;
  };
  if (options.video && std::ranges::any_of(views, differs))
    return make_error(options.cameras,
                      {Errc::bad_argument, Error::kNone, "the frames of a video need one size; set it with --size"});
  return options.photos.empty() ? Outcome<std::vector<View>>(std::move(views)) : with_photos(std::move(views), options);
}

Outcome<Image> read_photo(const View& view) {
  auto photo = read_image(view.photo);
  if (!photo) return make_error(view.photo, photo.error());
  if (photo->channels == 3) return *std::move(photo);
  Image rgb = Image::make(photo->width, photo->height, 3);
  const auto stride = static_cast<std::size_t>(photo->channels);
  for (std::size_t i = 0; i < rgb.pixels.size(); ++i)
    rgb.pixels[i] = photo->pixels[i / 3 * stride + (stride < 3 ? 0 : i % 3)];
  return rgb;
}

}  // namespace rgs::audit
