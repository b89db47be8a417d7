// input_files.cpp - identifies files by device and inode, and detects changes by their times.
// SPDX-License-Identifier: Apache-2.0
#include "input_files.hpp"

#include <unistd.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>
#include <string_view>
#include <system_error>
#include <tuple>
#include <utility>
#include <vector>

#include "console.hpp"
#include "rgs/file.hpp"
#include "rgs/tileset_files.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs::tool {
namespace {

namespace fs = std::filesystem;
using detail::path_of;
using detail::status_of;

std::string lower_case(std::string text) {
  for (char& c : text) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return text;
}

// Regular files of a folder with one of these extensions, sorted.
template <std::size_t n>
std::vector<std::string> files_of(const fs::path& folder, const std::array<std::string_view, n>& extensions) {
  std::vector<std::string> paths;
  std::error_code failed;
  for (fs::directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed)) {
    std::error_code ignored;
    if (std::ranges::find(extensions, lower_case(it->path().extension().string())) != extensions.end() &&
        it->is_regular_file(ignored))
      paths.push_back(it->path().string());
  }
  std::ranges::sort(paths);
  return paths;
}

}  // namespace

std::string prj_of(const std::string& path) {
  const fs::path place = path_of(path);
  return lower_case(place.extension().string()) == ".ply" ? fs::path(place).replace_extension(".prj").string() : "";
}

InputFiles::State InputFiles::look(const std::string& path, int standard_stream) {
  State state;
  std::optional<detail::FileStatus> status;
  if (path == "-") {
    status = status_of(standard_stream);
    // A pipe or terminal cannot be overwritten.
    if (!status || status->kind != detail::FileStatus::Kind::regular) return state;
  } else if (const std::string target = follow_links(path); !(status = status_of(target))) {
    // From the innermost existing folder; others are still to be made.
    const fs::path place = path_of(target).lexically_normal();
    fs::path folder = place.parent_path();
    while (!folder.empty() && folder != folder.root_path() && !status_of(folder.string()))
      folder = folder.parent_path();
    const fs::path from = folder.empty() ? fs::path(".") : folder;
    if ((status = status_of(from.string())))
      state.identity = FileIdentity{status->device, status->inode, place.lexically_relative(from).string()};
    return state;
  }
  state.identity = FileIdentity{status->device, status->inode, {}};
  state.status = status;
  return state;
}

void InputFiles::add(const std::string& path) {
  if (path.empty()) return;
  paths_.push_back(path);
  states_.push_back(look(path, STDIN_FILENO));
}

void InputFiles::add_scene(const std::string& path) {
  add(path);
  const fs::path place = path_of(path);
  const fs::path folder = place.has_parent_path() ? place.parent_path() : ".";
  const std::string ending = lower_case(place.extension().string());
  const auto add_all = [this](const fs::path& in, const auto&... endings) {
    for (const std::string& file : files_of(in, std::array<std::string_view, sizeof...(endings)>{endings...}))
      add(file);
  };
  if (std::error_code ignored; fs::is_regular_file(path_of(prj_of(path)), ignored)) add(prj_of(path));
  if (place.filename() == "meta.json") add_all(folder, ".webp");
  if (ending == ".lcc" || ending == ".gltf") add_all(folder, ".bin");
  if (ending == ".rad") add_all(folder, ".radc");
  if (ending == ".lcc2") add_all(folder / "data" / "3dgs", ".sog", ".spz");
  for (const std::string& file : files_of_tileset(path)) add(file);
  if (place.filename() != "lod-meta.json") return;
  std::vector<fs::path> sogs;
  std::error_code failed;
  for (fs::directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed))
    sogs.push_back(it->path());
  std::ranges::sort(sogs);
  for (const fs::path& sog : sogs) {
    std::error_code ignored;
    if (!fs::is_regular_file(sog / "meta.json", ignored)) continue;
    add((sog / "meta.json").string());
    add_all(sog, ".webp");
  }
}

void InputFiles::add_cameras(const std::string& path) {
  std::error_code ignored;
  if (!fs::is_directory(path_of(path), ignored)) return add(path);
  for (const char* inside : {"", "sparse/0", "sparse"}) {
    for (const char* name : {"cameras.bin", "images.bin", "cameras.txt", "images.txt"}) {
      const fs::path file = path_of(path) / inside / name;
      if (fs::exists(file, ignored)) add(file.string());
    }
  }
}

void InputFiles::add_pictures(const std::string& folder) {
  if (folder.empty()) return;
  constexpr std::array<std::string_view, 7> kPictures{".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".ppm"};
  for (const std::string& picture : files_of(path_of(folder), kPictures)) add(picture);
}

std::string InputFiles::clash(std::span<const std::string> outputs) const {
  using Key = std::tuple<std::uint64_t, std::uint64_t, std::string>;
  std::map<Key, std::string> taken;  // the user's name of each file
  for (std::size_t i = 0; i < paths_.size(); ++i) {
    if (const auto& id = states_[i].identity) taken.emplace(Key(id->device, id->inode, id->name), "input " + paths_[i]);
  }
  bool has_stdout = false;
  for (const std::string& output : outputs) {
    if (output.empty()) continue;
    if (output == "-" && std::exchange(has_stdout, true)) return "two outputs go to standard output";
    const auto id = look(output, STDOUT_FILENO).identity;
    if (!id) continue;
    const auto [place, is_new] = taken.emplace(Key(id->device, id->inode, id->name), "output " + output);
    if (!is_new) return "output " + output + " is the same file as " + place->second;
  }
  return {};
}

int InputFiles::check_outputs(std::span<const std::string> outputs) const {
  const std::string message = clash(outputs);
  return message.empty() ? kSuccess : report_usage(message);
}

std::optional<std::string> InputFiles::changed() const {
  for (std::size_t i = 0; i < paths_.size(); ++i) {
    const State &before = states_[i], now = look(paths_[i], STDIN_FILENO);
    if (paths_[i] == "-" || !before.status || !now.status) continue;
    if (before.identity != now.identity || before.status->bytes != now.status->bytes ||
        before.status->modified != now.status->modified || before.status->changed != now.status->changed)
      return paths_[i];
  }
  return std::nullopt;
}

int InputFiles::check_unchanged() const {
  const auto path = changed();
  if (!path) return kSuccess;
  return report(*path, kFileChanged);
}

}  // namespace rgs::tool
