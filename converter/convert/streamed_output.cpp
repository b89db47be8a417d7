// streamed_output.cpp - a folder of files that appears at once, as far as a file system can do that; or a zip archive.
// SPDX-License-Identifier: Apache-2.0
#include "streamed_output.hpp"

#include <zlib.h>

#include <cerrno>
#include <filesystem>
#include <initializer_list>
#include <string_view>
#include <system_error>

#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;
using detail::path_of;

tl::unexpected<Error> cannot(const char* what, std::error_code code) {
  return make_error(Errc::write_failed, Error::kNone, what, Error::kNone, Error::kNone,
                    code.default_error_condition().value());
}

std::string folder_of(const std::string& path) {
  const std::string folder = path_of(path).parent_path().string();
  return folder.empty() ? "." : folder;
}

void append(std::vector<std::byte>& to, std::initializer_list<std::uint64_t> values, int n_bytes) {
  for (const std::uint64_t value : values) {
    for (int i = 0; i < n_bytes; ++i) to.push_back(static_cast<std::byte>(value >> (8 * i) & 255));
  }
}

}  // namespace

std::string folder_of_tiles(const std::string& path) {
  std::string name = path_of(follow_links(path)).filename().string();
  constexpr std::string_view kTiles = "tiles", kEnding = ".json";
  if (name == "tileset.json") return std::string(kTiles);
  if (name.ends_with(kEnding)) name.resize(name.size() - kEnding.size());
  // Not that of tileset.json.
  if (name.starts_with(kTiles) && name.find_first_not_of('_', kTiles.size()) == name.npos) name += '_';
  // "" and "." are this folder, ".." is another.
  if (name.find_first_not_of('.') == name.npos) return '~' + name;
  // A URI's path has neither \ nor :.
  std::string folder;
  for (const char c : name) {
    const char* escape = c == '\\' ? "~b" : c == ':' ? "~c" : c == '~' ? "~~" : nullptr;
    if (escape != nullptr) {
      folder += escape;
    } else {
      folder += c;
    }
  }
  return folder;
}

Result<StreamedOutput> StreamedOutput::create(const std::string& path, const AtomicFile::Options& options,
                                              const IsInput& is_input) {
  StreamedOutput output;
  output.path_ = path == "-" ? path : follow_links(path);  // the SOGs lie beside the file itself
  output.options_ = options;
  output.is_input_ = is_input;
  std::error_code failed;
  if (path != "-") output.made_folder_ = fs::create_directories(path_of(folder_of(output.path_)), failed);
  if (failed) return cannot("cannot make the output's folder", failed);
  auto file = AtomicFile::create(path, options);
  if (!file) return tl::unexpected(file.error());
  output.file_ = std::move(*file);
  if (!path.ends_with(".json")) return output;
  std::string name = output.path_ + ".tmp-XXXXXX";
  if (!detail::make_scratch_folder(name))
    return cannot("cannot make a temporary folder", {errno, std::generic_category()});
  output.staging_ = name;
  return output;
}

StreamedOutput::~StreamedOutput() {
  std::error_code ignored;
  if (!staging_.empty()) fs::remove_all(path_of(staging_), ignored);
  if (made_folder_) fs::remove(path_of(folder_of(path_)), ignored);  // if it is empty
}

Status StreamedOutput::put(const std::string& name, std::span<const std::byte> bytes) {
  return is_zip() ? put_zipped(name, bytes) : put_in_folder(name, bytes);
}

// Errors: output_exists, output_unusable.
Status StreamedOutput::check_free(const std::string& path) const {
  std::error_code ignored;
  if (!options_.overwrite && fs::exists(path_of(path), ignored))
    return make_error(Errc::output_exists, Error::kNone,
                      "a file of the output's folder exists already; pass --overwrite to replace it");
  if (fs::is_directory(path_of(path), ignored))
    return make_error(Errc::output_unusable, Error::kNone, "a file of the output's folder is a directory");
  if (is_input_ && is_input_(path))
    return make_error(Errc::output_unusable, Error::kNone,
                      "a file of the output's folder is one that is read: name another folder");
  return {};
}

Status StreamedOutput::put_in_folder(const std::string& name, std::span<const std::byte> bytes) {
  bytes_ += bytes.size();
  if (path_of(name).filename() == path_of(name)) return file_.write_at(0, bytes);
  if (Status s = check_free(folder_of(path_) + "/" + name); !s) return s;
  std::error_code failed;
  const std::string staged = staging_ + "/" + name;
  fs::create_directories(path_of(folder_of(staged)), failed);
  if (failed) return cannot("cannot make a folder", failed);
  auto file = AtomicFile::create(staged, {.sync = options_.sync});
  if (!file) return tl::unexpected(file.error());
  if (Status s = file->write_at(0, bytes); !s) return s;
  const auto synced = file->commit();
  if (!synced) return tl::unexpected(synced.error());
  sync_seconds_ += *synced;
  names_.push_back(name);
  return {};
}

// Local header, bytes; the directory's entry repeats the header (PKWARE's APPNOTE, 4.3.7 and 4.3.12).
Status StreamedOutput::put_zipped(const std::string& name, std::span<const std::byte> bytes) {
  constexpr std::uint64_t kVersion = 20, kUtf8 = 1 << 11, kStored = 0, kMidnight = 0, kFirstOf1980 = 0x21;
  constexpr std::uint64_t kMost = ~std::uint32_t{0};
  std::vector<std::byte> common;
  append(common, {kVersion, kUtf8, kStored, kMidnight, kFirstOf1980}, 2);
  append(common, {::crc32_z(0, reinterpret_cast<const Bytef*>(bytes.data()), bytes.size()), bytes.size(), bytes.size()},
         4);
  append(common, {name.size(), 0}, 2);
  std::vector<std::byte> header;
  append(header, {0x04034b50}, 4);
  header.insert(header.end(), common.begin(), common.end());
  append(directory_, {0x02014b50}, 4);
  append(directory_, {kVersion}, 2);
  directory_.insert(directory_.end(), common.begin(), common.end());
  append(directory_, {0, 0, 0, 0, 0}, 2);  // no comment, disk 0, no attributes
  append(directory_, {bytes_}, 4);
  for (std::vector<std::byte>* to : {&header, &directory_}) {
    const auto text = std::as_bytes(std::span(name));
    to->insert(to->end(), text.begin(), text.end());
  }
  names_.push_back(name);
  const std::uint64_t end = bytes_ + header.size() + bytes.size();
  if (end + directory_.size() > kMost || names_.size() >= 0xffff)
    return make_error(Errc::limit_exceeded, Error::kNone,
                      "a zip archive holds 4 GiB and 65,534 files; write a folder, named by its lod-meta.json", kMost,
                      end);
  if (Status s = file_.write_at(bytes_, header); !s) return s;
  if (Status s = file_.write_at(bytes_ + header.size(), bytes); !s) return s;
  bytes_ = end;
  return {};
}

Result<double> StreamedOutput::commit() {
  if (is_zip()) {
    const std::uint64_t size = directory_.size();
    append(directory_, {0x06054b50}, 4);
    append(directory_, {0, 0, names_.size(), names_.size()}, 2);
    append(directory_, {size, bytes_}, 4);
    append(directory_, {0}, 2);  // no comment
    if (Status s = file_.write_at(bytes_, directory_); !s) return tl::unexpected(s.error());
    bytes_ += directory_.size();
    return file_.commit();
  }
  for (const MappedFile* input : options_.inputs) {
    if (Status s = input->check_unchanged(); !s) return tl::unexpected(s.error());
  }
  // What can fail comes before the first change of what is there, which may have appeared since put().
  if (Status s = check_free(path_); !s) return tl::unexpected(s.error());
  std::error_code failed;
  const std::string folder = folder_of(path_) + "/";
  for (const std::string& name : names_) {
    if (Status s = check_free(folder + name); !s) return tl::unexpected(s.error());
    fs::create_directories(path_of(folder_of(folder + name)), failed);
    if (failed) return cannot("cannot make a folder", failed);
  }
  // The old scene's lod-meta.json must not name files of the new one.
  if (options_.overwrite) fs::remove(path_of(path_), failed);
  for (const std::string& name : names_) {
    if (!failed) fs::rename(path_of(staging_ + "/" + name), path_of(folder + name), failed);
  }
  if (failed) return cannot("cannot move a file to the output's folder", failed);
  const auto synced = file_.commit();
  if (!synced) return synced;
  return *synced + sync_seconds_;
}

}  // namespace rgs
