// spool_file.cpp - temporary bytes on POSIX: O_TMPFILE, or mkostemp and unlink where a file system lacks it.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/spool_file.hpp"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <string>
#include <utility>

namespace rgs::detail {
namespace {

constexpr std::size_t kBufferBytes = std::size_t{1} << 20;

// Moves the descriptor above 2: messages to a closed standard stream must not end up in the file.
int beyond_standard_streams(int fd) {
  if (fd < 0 || fd > STDERR_FILENO) return fd;
  const int moved = ::fcntl(fd, F_DUPFD_CLOEXEC, STDERR_FILENO + 1);
  const int error = errno;
  ::close(fd);
  errno = error;
  return moved;
}

int open_unlinked() {
  const char* variable = std::getenv("TMPDIR");
  const std::string folder = variable != nullptr && *variable != '\0' ? variable : "/tmp";
  const int fd = ::open(folder.c_str(), O_TMPFILE | O_RDWR | O_CLOEXEC, 0600);
  if (fd >= 0) return beyond_standard_streams(fd);
  std::string path = folder + "/rgs-spool-XXXXXX";
  const int named = ::mkostemp(path.data(), O_CLOEXEC);
  if (named >= 0) ::unlink(path.c_str());
  return beyond_standard_streams(named);
}

}  // namespace

SpoolFile::~SpoolFile() {
  if (fd_ >= 0) ::close(fd_);
}

Status SpoolFile::append(std::span<const std::byte> bytes) {
  while (!bytes.empty()) {
    if (buffer_.size() == kBufferBytes) {
      if (auto flushed = flush(); !flushed) return flushed;
    }
    const auto part = bytes.first(std::min(bytes.size(), kBufferBytes - buffer_.size()));
    buffer_.insert(buffer_.end(), part.begin(), part.end());
    bytes = bytes.subspan(part.size());
  }
  return {};
}

Status SpoolFile::flush() {
  if (fd_ < 0) {
    fd_ = open_unlinked();
    if (fd_ < 0) {
      return make_error(Errc::open_failed, Error::kNone,
                        "cannot create a temporary file; set TMPDIR to a writable folder", Error::kNone, Error::kNone,
                        errno);
    }
    spilled_ = true;
  }
  for (std::span<const std::byte> rest = buffer_; !rest.empty();) {
    const ssize_t n = ::pwrite(fd_, rest.data(), rest.size(), static_cast<off_t>(written_));
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) {
      return make_error(Errc::write_failed, Error::kNone,
                        "cannot write the temporary file; set TMPDIR to a folder with more room", Error::kNone,
                        Error::kNone, n == 0 ? ENOSPC : errno);
    }
    rest = rest.subspan(static_cast<std::size_t>(n));
    written_ += static_cast<std::uint64_t>(n);
  }
  buffer_.clear();
  return {};
}

Status SpoolFile::finish() {
  if (!spilled_) return {};
  if (auto flushed = flush(); !flushed) return flushed;
  buffer_ = std::vector<std::byte>();  // `= {}` would keep the memory
  auto mapped = MappedFile::map(fd_);
  if (!mapped) return tl::unexpected(mapped.error());
  file_ = std::move(*mapped);
  ::close(std::exchange(fd_, -1));
  return {};
}

}  // namespace rgs::detail
