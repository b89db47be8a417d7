// cameras_file.cpp - detects the kind of a camera file or folder and reads it.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <filesystem>
#include <numeric>
#include <string>
#include <utility>

#include "cameras/camera_records.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

constexpr std::uint64_t kMaxJsonBytes = std::uint64_t{256} << 20;

std::string_view text_of(const MappedFile& file) {
  return {reinterpret_cast<const char*>(file.bytes().data()), file.bytes().size()};
}

Result<CameraSet> read_colmap(const std::filesystem::path& folder) {
  std::error_code ignored;
  for (const char* inside : {"", "sparse/0", "sparse"}) {
    for (const bool binary : {true, false}) {
      const std::string suffix = binary ? ".bin" : ".txt";
      const auto cameras_path = folder / inside / ("cameras" + suffix),
                 images_path = folder / inside / ("images" + suffix);
      if (!std::filesystem::exists(cameras_path, ignored) || !std::filesystem::exists(images_path, ignored)) continue;
      const auto cameras = MappedFile::open(cameras_path.string());
      if (!cameras) return tl::unexpected(cameras.error());
      const auto images = MappedFile::open(images_path.string());
      if (!images) return tl::unexpected(images.error());
      return binary ? parse_colmap_binary(cameras->bytes(), images->bytes())
                    : parse_colmap_text(text_of(*cameras), text_of(*images));
    }
  }
  return make_error(
      Errc::open_failed, Error::kNone,
      "the folder holds no COLMAP model: cameras and images, .bin or .txt, here, in sparse/0 or in sparse");
}

}  // namespace

namespace detail {

void split_by_name(CameraSet& set) {
  std::vector<std::size_t> order(set.cameras.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t a, std::size_t b) { return set.cameras[a].name < set.cameras[b].name; });
  set.split.assign(order.size(), Split::train);
  for (std::size_t i = 0; i < order.size(); i += 8) set.split[order[i]] = Split::test;
}

}  // namespace detail

Result<CameraSet> read_camera_set(const std::string& path) {
  return detail::guard_memory([&]() -> Result<CameraSet> {
    std::error_code ignored;
    if (const auto folder = detail::path_of(path); std::filesystem::is_directory(folder, ignored))
      return read_colmap(folder);
    const auto file = MappedFile::open(path);
    if (!file) return tl::unexpected(file.error());
    std::string_view text = text_of(*file);
    const std::size_t mark = text.starts_with("\xef\xbb\xbf") ? 3 : 0;
    const std::size_t first = text.find_first_not_of(" \t\r\n", mark);
    if (first == std::string_view::npos)
      return make_error(Errc::truncated, text.size(), "an empty file; expected JSON with cameras");
    if (text[first] != '[' && text[first] != '{')
      return make_error(Errc::bad_syntax, first,
                        "not a camera file: expected JSON, or the folder of a COLMAP sparse model");
    if (text.size() > kMaxJsonBytes)
      return make_error(Errc::limit_exceeded, Error::kNone, "too large for a camera file", kMaxJsonBytes, text.size());
    return parse_camera_json(text);
  });
}

Result<std::vector<Camera>> read_cameras(const std::string& path) {
  auto set = read_camera_set(path);
  if (!set) return tl::unexpected(set.error());
  return std::move(set->cameras);
}

}  // namespace rgs
