// spool_file.cpp - temporary bytes in memory or an unnamed file.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/spool_file.hpp"

#include <unistd.h>

#include <algorithm>
#include <cerrno>
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
    fd_ = open_scratch({});
    if (fd_ < 0) {
      return make_error(Errc::open_failed, Error::kNone,
                        "cannot create a temporary file; set TMPDIR (Windows: TMP) to a writable folder", Error::kNone,
                        Error::kNone, errno);
    }
    spilled_ = true;
  }
  if (const int error = write_at(fd_, written_, buffer_); error != 0) {
    return make_error(Errc::write_failed, Error::kNone,
                      "cannot write the temporary file; set TMPDIR (Windows: TMP) to a folder with more room",
                      Error::kNone, Error::kNone, error);
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
