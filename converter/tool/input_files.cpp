// input_files.cpp - identifies files by device and inode, and detects changes by their times.
// SPDX-License-Identifier: Apache-2.0
#include "input_files.hpp"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string_view>
#include <system_error>
#include <tuple>
#include <utility>
#include <vector>

#include "console.hpp"
#include "rgs/file.hpp"

namespace rgs::tool {
namespace {

namespace fs = std::filesystem;

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

// Values of "uri" and, of drafts before 1.0, "url" in a text of JSON, as paths that stay below its folder.
std::vector<fs::path> named_by(const std::string& path) {
  constexpr std::size_t kMaxBytes = std::size_t{1} << 25;  // of a tileset; a longer .gltf embeds its buffers
  std::vector<fs::path> named;
  const auto file = MappedFile::open(path);
  if (!file || file->bytes().size() > kMaxBytes) return named;
  const std::string_view text(reinterpret_cast<const char*>(file->bytes().data()), file->bytes().size());
  std::string key;
  const auto visit = [&](int, nlohmann::json::parse_event_t event, const nlohmann::json& value) {
    if (event == nlohmann::json::parse_event_t::key) key = value.get_ref<const std::string&>();
    if (event != nlohmann::json::parse_event_t::value || !value.is_string() || (key != "uri" && key != "url"))
      return true;
    std::string uri = value.get_ref<const std::string&>();
    for (std::size_t at = 0; (at = uri.find('%', at)) < uri.size() - std::min<std::size_t>(uri.size(), 2); ++at) {
      unsigned code = 0;
      const char* digits = uri.data() + at + 1;
      if (std::from_chars(digits, digits + 2, code, 16).ptr == digits + 2)
        uri.replace(at, 3, 1, static_cast<char>(code));
    }
    const fs::path inside = fs::path(uri).lexically_normal();
    if (!uri.starts_with("data:") && !inside.empty() && inside.is_relative() && *inside.begin() != "..")
      named.push_back(inside);
    return true;
  };
  const auto parsed = nlohmann::json::parse(text, visit, false);
  return parsed.is_discarded() ? std::vector<fs::path>() : named;
}

// Whether a name is that of a template, whose variables in braces are numbers.
bool matches(std::string_view name, std::string_view pattern) {
  while (!pattern.empty()) {
    if (name.empty()) return false;
    if (pattern.front() == '{' && pattern.find('}') != pattern.npos) {
      const std::size_t digits = std::min(name.find_first_not_of("0123456789"), name.size());
      if (digits == 0) return false;
      name.remove_prefix(digits);
      pattern.remove_prefix(pattern.find('}') + 1);
    } else {
      if (name.front() != pattern.front()) return false;
      name.remove_prefix(1);
      pattern.remove_prefix(1);
    }
  }
  return name.empty();
}

// A file, or, of the template of an implicit tiling, all that have its names.
std::vector<fs::path> files_named(const fs::path& folder, const fs::path& name) {
  const std::string pattern = (folder / name).lexically_normal().string();
  if (name.string().find('{') == std::string::npos) return {pattern};
  std::vector<fs::path> files;
  fs::path above = folder;
  for (const fs::path& part : name) {
    if (part.string().find('{') != std::string::npos) break;
    above /= part;
  }
  std::error_code failed;
  for (fs::recursive_directory_iterator it(above, failed), end; !failed && it != end; it.increment(failed)) {
    fs::path file = it->path().lexically_normal();
    if (matches(file.string(), pattern)) files.push_back(std::move(file));
  }
  return files;
}

// The files that a tileset, its external ones and the .gltf of both name, each once, sorted.
std::set<std::string> contents_of(const std::string& path, const fs::path& folder) {
  constexpr std::size_t kMost = std::size_t{1} << 20;  // more tiles are not read
  std::set<std::string> contents;
  std::vector<std::pair<std::string, fs::path>> texts{{path, folder}};
  while (!texts.empty()) {
    const auto [text, base] = texts.back();
    texts.pop_back();
    for (const fs::path& name : named_by(text)) {
      for (const fs::path& file : files_named(base, name)) {
        std::error_code ignored;
        if (contents.size() == kMost) return contents;
        if (!fs::is_regular_file(file, ignored) || !contents.insert(file.string()).second) continue;
        const std::string ending = lower_case(file.extension().string());
        if (ending == ".json" || ending == ".gltf") texts.emplace_back(file.string(), file.parent_path());
      }
    }
  }
  contents.erase(fs::path(path).lexically_normal().string());
  return contents;
}

}  // namespace

std::string prj_of(const std::string& path) {
  const fs::path place(path);
  return lower_case(place.extension().string()) == ".ply" ? fs::path(place).replace_extension(".prj").string() : "";
}

InputFiles::State InputFiles::look(const std::string& path, int standard_stream) {
  State state;
  struct stat info {};
  if (path == "-") {
    // A pipe or terminal cannot be overwritten.
    if (::fstat(standard_stream, &info) != 0 || !S_ISREG(info.st_mode)) return state;
  } else if (const std::string target = follow_links(path); ::stat(target.c_str(), &info) != 0) {
    // From the innermost existing folder; others are still to be made.
    const fs::path place = fs::path(target).lexically_normal();
    fs::path folder = place.parent_path();
    while (!folder.empty() && folder != folder.root_path() && ::stat(folder.c_str(), &info) != 0)
      folder = folder.parent_path();
    const fs::path from = folder.empty() ? fs::path(".") : folder;
    if (::stat(from.c_str(), &info) == 0)
      state.identity = FileIdentity{info.st_dev, info.st_ino, place.lexically_relative(from).string()};
    return state;
  }
  state.identity = FileIdentity{info.st_dev, info.st_ino, {}};
  state.exists = true;
  state.bytes = static_cast<std::uint64_t>(info.st_size);
  state.modified[0] = info.st_mtim.tv_sec, state.modified[1] = info.st_mtim.tv_nsec;
  state.status_changed[0] = info.st_ctim.tv_sec, state.status_changed[1] = info.st_ctim.tv_nsec;
  return state;
}

void InputFiles::add(const std::string& path) {
  if (path.empty()) return;
  paths_.push_back(path);
  states_.push_back(look(path, STDIN_FILENO));
}

void InputFiles::add_scene(const std::string& path) {
  add(path);
  const fs::path place(path);
  const fs::path folder = place.has_parent_path() ? place.parent_path() : ".";
  const std::string ending = lower_case(place.extension().string());
  const auto add_all = [this](const fs::path& in, const auto&... endings) {
    for (const std::string& file : files_of(in, std::array<std::string_view, sizeof...(endings)>{endings...}))
      add(file);
  };
  if (std::error_code ignored; fs::is_regular_file(prj_of(path), ignored)) add(prj_of(path));
  if (place.filename() == "meta.json") add_all(folder, ".webp");
  if (ending == ".lcc" || ending == ".gltf") add_all(folder, ".bin");
  if (ending == ".rad") add_all(folder, ".radc");
  if (ending == ".lcc2") add_all(folder / "data" / "3dgs", ".sog", ".spz");
  if (ending == ".json" && place.filename() != "meta.json" && place.filename() != "lod-meta.json") {  // a tileset
    for (const std::string& content : contents_of(path, folder)) add(content);
  }
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
  if (!fs::is_directory(path, ignored)) return add(path);
  for (const char* inside : {"", "sparse/0", "sparse"}) {
    for (const char* name : {"cameras.bin", "images.bin", "cameras.txt", "images.txt"}) {
      const fs::path file = fs::path(path) / inside / name;
      if (fs::exists(file, ignored)) add(file.string());
    }
  }
}

void InputFiles::add_pictures(const std::string& folder) {
  if (folder.empty()) return;
  constexpr std::array<std::string_view, 7> kPictures{".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".ppm"};
  for (const std::string& picture : files_of(folder, kPictures)) add(picture);
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
    if (paths_[i] == "-" || !before.exists || !now.exists) continue;
    if (before.identity != now.identity || before.bytes != now.bytes ||
        !std::ranges::equal(before.modified, now.modified) ||
        !std::ranges::equal(before.status_changed, now.status_changed))
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
