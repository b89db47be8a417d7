// photo_folder.cpp - finds pictures by name, with and without extension.
// SPDX-License-Identifier: Apache-2.0
#include "photo_folder.hpp"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <vector>

#include "image_file.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {

namespace fs = std::filesystem;

Result<PhotoFolder> PhotoFolder::open(const std::string& path) {
  std::error_code failed;
  std::vector<fs::path> files;
  for (fs::directory_iterator it(detail::path_of(path), failed), end; !failed && it != end; it.increment(failed))
    if (image_format(it->path().string())) files.push_back(it->path());
  if (failed)
    return make_error(Errc::open_failed, Error::kNone, "cannot read the folder of photographs", Error::kNone,
                      Error::kNone, failed.value());
  std::sort(files.begin(), files.end());
  PhotoFolder folder;
  for (const fs::path& file : files) {
    folder.files_.emplace(file.stem().string(), file.string());
    folder.files_[file.filename().string()] = file.string();
  }
  return folder;
}

std::string PhotoFolder::find(const std::string& camera_name) const {
  const fs::path name = detail::path_of(camera_name);
  auto photo = files_.find(name.filename().string());
  if (photo == files_.end() && image_format(camera_name)) photo = files_.find(name.stem().string());
  return photo == files_.end() ? std::string() : photo->second;
}

}  // namespace rgs
