// spool_file.cpp - temporary bytes in memory or an unnamed file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/spool_file.hpp"

#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <utility>

namespace rgs::detail {
namespace {

constexpr std::size_t kBufferBytes = std::size_t{1} << 20;

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
    const char* folder = std::getenv("TMPDIR");
    fd_ = open_scratch(folder != nullptr && *folder != '\0' ? folder : "/tmp");
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
