// served_file.cpp - files by device, inode, size and times.
// SPDX-License-Identifier: Apache-2.0
#include "served_file.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <utility>

namespace rgs::view {
namespace {

constexpr const char* kChanged = "the file has changed; start rgs-view again";

FileStamp stamp_of(const struct stat& info) {
  constexpr std::int64_t kSecond = 1'000'000'000;
  return {info.st_dev,
          info.st_ino,
          static_cast<std::uint64_t>(info.st_size),
          info.st_nlink,
          info.st_mtim.tv_sec * kSecond + info.st_mtim.tv_nsec,
          info.st_ctim.tv_sec * kSecond + info.st_ctim.tv_nsec};
}

tl::unexpected<Error> open_error(const char* what, int system = 0) {
  return make_error(Errc::open_failed, Error::kNone, what, Error::kNone, Error::kNone, system);
}

}  // namespace

bool FileStamp::same(const FileStamp& other) const {
  return device == other.device && inode == other.inode && bytes == other.bytes && modified_ns == other.modified_ns &&
         (changed_ns == other.changed_ns || names != other.names);
}

OpenFile::~OpenFile() {
  ::close(fd_);
}

Status OpenFile::read_at(std::uint64_t offset, std::span<char> out) const {
  while (!out.empty()) {
    const ssize_t n = ::pread(fd_, out.data(), out.size(), static_cast<off_t>(offset));
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return make_error(Errc::read_failed, offset, "cannot be read", Error::kNone, Error::kNone, errno);
    if (n == 0) return make_error(Errc::read_failed, offset, kChanged);
    offset += static_cast<std::uint64_t>(n);
    out = out.subspan(static_cast<std::size_t>(n));
  }
  // Checked after reading, so that a change before or during the read is found.
  struct stat info {};
  if (::fstat(fd_, &info) != 0 || !stamp_of(info).same(stamp_))
    return make_error(Errc::read_failed, Error::kNone, kChanged);
  return {};
}

Result<ServedFile> ServedFile::look(const std::string& path) {
  struct stat info {};
  if (::stat(path.c_str(), &info) != 0) return open_error("cannot be opened", errno);
  if (!S_ISREG(info.st_mode)) return open_error("is no regular file");
  if (::access(path.c_str(), R_OK) != 0) return open_error("cannot be opened", errno);
  ServedFile file;
  file.path_ = path;
  file.stamp_ = stamp_of(info);
  return file;
}

std::string ServedFile::tag() const {
  return fmt::format("\"{:x}-{:x}-{:x}\"", stamp_.inode, stamp_.bytes, stamp_.modified_ns);
}

Result<std::shared_ptr<const OpenFile>> ServedFile::open() const {
  // Does not block if a pipe has taken the file's place.
  const int fd = ::open(path_.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0) return open_error("cannot be opened", errno);
  auto file = std::make_shared<const OpenFile>(fd, stamp_);
  struct stat info {};
  if (::fstat(fd, &info) != 0 || !stamp_of(info).same(stamp_))
    return make_error(Errc::read_failed, Error::kNone, kChanged);
  return file;
}

const char* content_type(std::string_view path) {
  constexpr std::array<std::pair<std::string_view, const char*>, 15> kTypes{
      {{".html", "text/html; charset=utf-8"},
       {".js", "text/javascript; charset=utf-8"},
       {".mjs", "text/javascript; charset=utf-8"},
       {".css", "text/css; charset=utf-8"},
       {".json", "application/json"},
       {".webmanifest", "application/manifest+json"},
       {".wasm", "application/wasm"},
       {".svg", "image/svg+xml"},
       {".png", "image/png"},
       {".jpg", "image/jpeg"},
       {".jpeg", "image/jpeg"},
       {".webp", "image/webp"},
       {".ico", "image/x-icon"},
       {".woff2", "font/woff2"},
       {".txt", "text/plain; charset=utf-8"}}};
  std::string lower(path.substr(std::min(path.rfind('.'), path.size())));
  std::ranges::transform(lower, lower.begin(),
                         [](char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; });
  for (const auto& [ending, type] : kTypes)
    if (lower == ending) return type;
  return "application/octet-stream";
}

}  // namespace rgs::view
