// scene_list.cpp - walks a folder once; the content decides, the name only if the content does not.
// SPDX-License-Identifier: Apache-2.0
#include "scene_list.hpp"

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <iterator>
#include <set>
#include <string_view>
#include <utility>

#include "input_files.hpp"
#include "rgs/file.hpp"
#include "rgs/tileset_files.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs::tool {
namespace {

namespace fs = std::filesystem;

// A streamed SOG.
const std::string kScene = "lod-meta.json";
constexpr std::string_view kGltfText = ".gltf";  // never an output, so unknown to format_of_name()

using Identity = std::pair<std::uint64_t, std::uint64_t>;  // device and inode

Identity identity(const detail::FileStatus& status) {
  return {status.device, status.inode};
}

std::string_view text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

// An output left by a killed program: NAME.tmp-XXXXXX.
bool is_unfinished(std::string_view name) {
  constexpr std::string_view kMark = ".tmp-";
  return name.size() > kMark.size() + 6 && name.substr(name.size() - kMark.size() - 6, kMark.size()) == kMark;
}

// A folder of a streamed SOG as its writers call them: "2_13".
bool is_level_and_number(std::string_view name) {
  constexpr std::string_view kDigits = "0123456789";
  const std::size_t level = std::min(name.find_first_not_of(kDigits), name.size());
  const std::string_view rest = name.substr(level);
  return level != 0 && rest.size() > 1 && rest[0] == '_' && rest.find_first_not_of(kDigits, 1) == rest.npos;
}

// Stricter than detect_format() where the name disagrees: many files are zip archives, and a text may begin with "ply".
SplatFormat format_of(std::span<const std::byte> bytes, SplatFormat by_name) {
  const SplatFormat format = detect_format(bytes);
  const std::string_view text = text_of(bytes);
  constexpr std::size_t kDirectory = 65536;  // at the end of a zip archive; a scene has a dozen files
  const std::string_view directory = text.substr(text.size() - std::min(text.size(), kDirectory));
  // Other arrays and tensors are no scenes: training leaves many.
  if (format == SplatFormat::npz || format == SplatFormat::pt) {
    const bool is_scene =
        (format == SplatFormat::npz ? directory : text.substr(0, kDirectory)).find("quats") != text.npos;
    return is_scene && by_name != SplatFormat::unknown ? format : SplatFormat::unknown;
  }
  if (by_name != SplatFormat::unknown) return format;
  // Other .gltf files are no scenes, nor is any other JSON with such a key.
  if (format == SplatFormat::glb && !text.starts_with("glTF") && text.find("\"KHR_gaussian_splatting") == text.npos)
    return SplatFormat::unknown;
  if (format == SplatFormat::sog && text.starts_with("PK") && directory.find("meta.json") == text.npos)
    return SplatFormat::unknown;
  if (format == SplatFormat::ply && !text.starts_with("ply\n") && !text.starts_with("ply\r"))
    return SplatFormat::unknown;
  return format;
}

class Walk {
 public:
  Walk(const std::vector<std::string>& without, bool hidden) : hidden_(hidden) {
    for (const std::string& folder : without) {
      if (const auto status = detail::status_of(folder)) without_.push_back(identity(*status));
    }
  }

  Status folder(const std::string& path, const std::string& prefix) {
    const auto status = detail::status_of(path);
    if (!status)
      return rgs::make_error(Errc::open_failed, Error::kNone, "cannot read the folder", Error::kNone, Error::kNone,
                             errno);
    const Identity self = identity(*status);
    if (std::ranges::find(without_, self) != without_.end()) return {};
    if (std::ranges::find(above_, self) != above_.end()) {
      list_.refused.push_back(prefix.substr(0, prefix.size() - 1));
      return {};
    }
    std::vector<std::string> names;
    std::error_code failed;
    for (fs::directory_iterator it(detail::path_of(path), failed), end; !failed && it != end; it.increment(failed))
      names.push_back(it->path().filename().string());
    if (failed)
      return rgs::make_error(Errc::open_failed, Error::kNone, "cannot read the folder", Error::kNone, Error::kNone,
                             failed.value());
    std::ranges::sort(names);
    const std::string inside = path + "/";
    // Folders that a streamed SOG names hold parts of it at several levels, and no scenes; so do others that have the
    // names of such, which an older scene may have left.
    std::string streamed;
    if (std::ranges::binary_search(names, kScene)) {
      const auto file = MappedFile::open(inside + kScene);
      if (file && detect_format(file->bytes()) == SplatFormat::ssog) streamed = text_of(file->bytes());
    }
    if (!streamed.empty()) {
      for (const std::string& file : files_of_scene(inside + kScene)) {
        const fs::path part = detail::path_of(file);
        if (part.filename() != kScene && is_level_and_number(part.parent_path().filename().string())) add_part(file);
      }
    }
    const auto is_part = [&streamed](const std::string& name) {
      return streamed.find('"' + name + '/') != streamed.npos || streamed.find('"' + name + "\\/") != streamed.npos;
    };
    // Nor are the files that a tileset is read from. First come those that name others of the folder, as a rule.
    std::vector<std::string> texts{"tileset.json"};
    std::ranges::copy_if(names, std::back_inserter(texts), [this](const std::string& name) {
      return (name.ends_with(".json") || name.ends_with(".JSON")) && name != "tileset.json" &&
             (hidden_ || name[0] != '.') && !is_unfinished(name);
    });
    for (const std::string& name : texts) {
      const auto text = detail::status_of(inside + name);
      if (!text || text->kind != detail::FileStatus::Kind::regular || parts_.contains(identity(*text))) continue;
      for (const std::string& part : files_of_tileset(inside + name)) add_part(part);
    }
    above_.push_back(self);
    // So are the chunks that an .lcc2 names.
    const bool chunks = std::ranges::any_of(names, [&inside](const std::string& name) {
      if (!name.ends_with(".lcc2")) return false;
      const auto file = MappedFile::open(inside + name);
      const std::string_view text = file ? text_of(file->bytes()) : std::string_view();
      return text.find("\"data/") != text.npos || text.find("\"data\\/") != text.npos;
    });
    for (const std::string& name : names)
      if (!(chunks && name == "data") && !is_part(name)) entry(inside + name, prefix + name, name[0] == '.');
    above_.pop_back();
    return {};
  }

  SceneList finish() {
    std::ranges::sort(list_.scenes, {}, &ListedScene::name);
    // A SOG's pictures, the buffers of a .gltf and the files of an LCC do not count as other files.
    list_.n_others -= std::min(list_.n_others, n_beside_);
    return std::move(list_);
  }

 private:
  void add_part(const std::string& path) {
    if (const auto status = detail::status_of(path)) parts_.insert(identity(*status));
  }

  void entry(const std::string& path, const std::string& name, bool is_hidden) {
    if (is_hidden && !hidden_) return;
    ListedScene scene{name, path, SplatFormat::unknown, 0, {}};
    const SplatFormat by_name = is_unfinished(name) ? SplatFormat::unknown : format_of_name(name);
    const auto status = detail::status_of(path);
    if (!status) {
      // A dangling link, or a file that vanished meanwhile.
      if (by_name == SplatFormat::unknown) return void(++list_.n_others);
      scene.readable =
          rgs::make_error(Errc::open_failed, Error::kNone, "cannot open file", Error::kNone, Error::kNone, errno);
      return list_.scenes.push_back(std::move(scene));
    }
    if (status->kind == detail::FileStatus::Kind::folder) {
      if (is_hidden) return;
      scene.readable = folder(path, name + "/");
      if (!scene.readable) list_.scenes.push_back(std::move(scene));
      return;
    }
    if (parts_.contains(identity(*status))) return;
    if (status->kind != detail::FileStatus::Kind::regular || is_unfinished(name)) return void(++list_.n_others);
    scene.bytes = status->bytes;
    const auto file = MappedFile::open(path);
    if (file) scene.format = format_of(file->bytes(), by_name);
    if (!file && by_name != SplatFormat::unknown) scene.readable = tl::unexpected(file.error());
    const bool is_meta =
        (by_name == SplatFormat::sog || by_name == SplatFormat::ssog || by_name == SplatFormat::tileset) &&
        name.ends_with(".json");  // others may have a meta.json too
    const bool is_arrays = by_name == SplatFormat::npz || by_name == SplatFormat::pt;
    if (scene.format == SplatFormat::unknown && (by_name == SplatFormat::unknown || ((is_meta || is_arrays) && file)))
      return void(++list_.n_others);
    if (format_info(scene.format).in_folder) {
      for (const std::string& file_of_it : files_of_scene(path)) {
        const auto of_it = detail::status_of(file_of_it);
        if (file_of_it == path || !of_it) continue;
        scene.bytes += of_it->bytes;
        const bool is_walked = scene.format != SplatFormat::lcc2 && scene.format != SplatFormat::tileset &&
                               scene.format != SplatFormat::ssog;
        n_beside_ += is_walked ? 1 : 0;
      }
    }
    list_.scenes.push_back(std::move(scene));
  }

  SceneList list_;
  std::vector<Identity> without_, above_;
  std::set<Identity> parts_;  // of tilesets
  std::uint64_t n_beside_ = 0;
  bool hidden_ = false;
};

}  // namespace

Result<SceneList> list_scenes(const std::string& folder, const std::vector<std::string>& without, bool hidden) {
  Walk walk(without, hidden);
  if (const Status s = walk.folder(folder, ""); !s) return tl::unexpected(s.error());
  return walk.finish();
}

std::vector<std::string> files_of_scene(const std::string& path) {
  InputFiles files;
  files.add_scene(path);
  return files.paths();
}

std::string scene_stem(const std::string& name) {
  if (name.ends_with(kGltfText)) return name.substr(0, name.size() - kGltfText.size());
  const SplatFormat format = format_of_name(name);
  if (format == SplatFormat::unknown) return name;
  // The ending of a SOG's meta.json is no format's.
  const std::size_t ending =
      name.ends_with(".json") || name.ends_with(".JSON") ? 5 : std::string_view(format_name(format)).size() + 1;
  return name.substr(0, name.size() - ending);
}

}  // namespace rgs::tool
