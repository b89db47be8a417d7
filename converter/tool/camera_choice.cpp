// camera_choice.cpp - chooses cameras by split, name or index.
// SPDX-License-Identifier: Apache-2.0
#include "camera_choice.hpp"
#include "rgs/utf8_path.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <filesystem>
#include <set>
#include <string_view>

namespace rgs {
namespace {

// ".jpg" is an extension, the ".0001" of "frame.0001" is not.
bool names_photograph(const std::filesystem::path& name) {
  constexpr std::array<std::string_view, 6> kExtensions{".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"};
  std::string extension = name.extension().string();
  for (char& c : extension) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return std::ranges::find(kExtensions, extension) != kExtensions.end();
}

}  // namespace

std::string picture_stem(const Camera& camera, std::size_t index) {
  const std::filesystem::path name = detail::path_of(camera.name);
  std::string stem = names_photograph(name) ? name.stem().string() : name.filename().string();
  for (char& c : stem) {
    const bool plain = (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
    if (!plain && c != '-' && c != '.' && static_cast<unsigned char>(c) < 0x80) c = '_';
  }
  if (stem.empty() || stem.front() == '.') stem = fmt::format("view_{:04}", index) + stem;
  return stem;
}

std::vector<std::string> picture_paths(const std::string& folder, std::span<const Camera> cameras,
                                       std::span<const char* const> kinds) {
  std::vector<std::string> paths;
  std::set<std::string> used;
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    std::string stem = picture_stem(cameras[i], i);
    while (!used.insert(stem).second) stem += fmt::format("_{:04}", i);
    for (const char* kind : kinds) paths.push_back((detail::path_of(folder) / (stem + "." + kind + ".png")).string());
  }
  return paths;
}

tl::expected<std::vector<Camera>, std::string> choose_cameras(const CameraSet& set, const std::string& split,
                                                              const std::string& view) {
  std::vector<Camera> chosen;
  for (std::size_t i = 0; i < set.cameras.size(); ++i) {
    const bool test = set.split[i] == Split::test;
    if (split.empty() || test == (split == "test")) chosen.push_back(set.cameras[i]);
  }
  if (chosen.empty()) return tl::unexpected("no camera is in the split '" + split + "'");
  if (view == "all") return chosen;
  for (const Camera& camera : chosen)
    if (camera.name == view || picture_stem(camera, 0) == view) return std::vector{camera};
  std::size_t index = 0;
  const auto [end, error] = std::from_chars(view.data(), view.data() + view.size(), index);
  if (error == std::errc() && end == view.data() + view.size() && index < chosen.size())
    return std::vector{chosen[index]};
  return tl::unexpected(
      fmt::format("--view takes a camera's name, an index from 0 to {}, or all, not '{}'", chosen.size() - 1, view));
}

}  // namespace rgs
