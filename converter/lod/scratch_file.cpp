// scratch_file.cpp - scratch bytes in memory or an unnamed file.
// SPDX-License-Identifier: Apache-2.0
#include "scratch_file.hpp"

#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <string_view>
#include <utility>

#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs::lod {
namespace {

constexpr const char* kNotMade = "cannot create a scratch file; name a writable folder with --scratch";
constexpr const char* kNotWritten = "cannot write a scratch file; name a folder with more room with --scratch";
constexpr const char* kNotRead = "cannot read a scratch file";

}  // namespace

bool concerns_scratch(const Error& error) {
  const std::string_view what = error.what;
  return what == kNotMade || what == kNotWritten || what == kNotRead;
}

Result<ScratchFile> ScratchFile::create(const std::string& folder) {
  ScratchFile file;
  file.fd_ = detail::open_scratch(folder.empty() ? "." : folder);
  if (file.fd_ < 0) {
    return make_error(Errc::open_failed, Error::kNone, kNotMade, Error::kNone, Error::kNone, errno);
  }
  return file;
}

ScratchFile::ScratchFile(ScratchFile&& other) noexcept
    : fd_(std::exchange(other.fd_, -1)), memory_(std::move(other.memory_)) {}

ScratchFile& ScratchFile::operator=(ScratchFile&& other) noexcept {
  std::swap(fd_, other.fd_);
  std::swap(memory_, other.memory_);
  return *this;
}

ScratchFile::~ScratchFile() {
  if (fd_ >= 0) ::close(fd_);
}

Status ScratchFile::write(std::uint64_t offset, std::span<const std::byte> bytes) {
  if (fd_ < 0) {
    return detail::guard_memory([&]() -> Status {
      if (memory_.size() < offset + bytes.size()) memory_.resize(offset + bytes.size());
      std::ranges::copy(bytes, memory_.begin() + static_cast<std::ptrdiff_t>(offset));
      return {};
    });
  }
  const int error = detail::write_at(fd_, offset, bytes);
  if (error == 0) return {};
  return make_error(Errc::write_failed, Error::kNone, kNotWritten, Error::kNone, Error::kNone, error);
}

Status ScratchFile::read(std::uint64_t offset, std::span<std::byte> bytes) const {
  if (fd_ < 0) {
    if (offset > memory_.size() || bytes.size() > memory_.size() - offset) {
      return make_error(Errc::read_failed, Error::kNone, "scratch memory ends too early");
    }
    std::copy_n(memory_.begin() + static_cast<std::ptrdiff_t>(offset), bytes.size(), bytes.begin());
    return {};
  }
  const int error = detail::read_at(fd_, offset, bytes);
  if (error == 0) return {};
  return make_error(Errc::read_failed, Error::kNone, kNotRead, Error::kNone, Error::kNone, std::max(error, 0));
}

}  // namespace rgs::lod
