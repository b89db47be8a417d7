// file.cpp - mapped input and all-or-nothing output: what is the same on every system.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/file.hpp"

#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

tl::unexpected<Error> system_error(Errc code, const char* what) {
  return make_error(code, Error::kNone, what, Error::kNone, Error::kNone, errno);
}

}  // namespace

Result<detail::FileStatus> detail::status_of_regular(int fd) {
  const auto status = status_of(fd);
  if (!status) return system_error(Errc::open_failed, "cannot read the file's size");
  if (status->kind == FileStatus::Kind::folder)
    return make_error(Errc::open_failed, Error::kNone, "is a directory, not a file");
  if (status->kind != FileStatus::Kind::regular)
    return make_error(Errc::open_failed, Error::kNone, "is not a regular file");
  return *status;
}

MappedFile::MappedFile(MappedFile&& other) noexcept
    : data_(std::exchange(other.data_, nullptr)),
      size_(std::exchange(other.size_, 0)),
      fd_(std::exchange(other.fd_, -1)),
      stamp_(other.stamp_) {}

MappedFile& MappedFile::operator=(MappedFile&& other) noexcept {
  std::swap(data_, other.data_);
  std::swap(size_, other.size_);
  std::swap(fd_, other.fd_);
  std::swap(stamp_, other.stamp_);
  return *this;
}

Result<MappedFile> MappedFile::open(const std::string& path) {
  const int fd = detail::open_to_read(path, false);
  if (fd < 0) return system_error(Errc::open_failed, "cannot open for reading");
  auto mapped = map(fd);
  ::close(fd);
  return mapped;
}

Status MappedFile::check_unchanged() const {
  if (fd_ < 0) return {};
  const auto now = detail::status_of(fd_);
  if (!now) return system_error(Errc::read_failed, "cannot read the file's size");
  if (now->bytes != size_) {
    return make_error(Errc::read_failed, std::min<std::uint64_t>(now->bytes, size_),
                      "the file's size changed while it was read", size_, now->bytes);
  }
  if (stamp_.is_unchanged(*now)) return {};
  return make_error(Errc::read_failed, Error::kNone, "the file changed while it was read; run the program again");
}

Result<AtomicFile> AtomicFile::create(const std::string& path, const Options& options) {
  return detail::guard_memory([&] { return begin(path, options); });
}

AtomicFile::AtomicFile(AtomicFile&& other) noexcept {
  *this = std::move(other);
}

AtomicFile& AtomicFile::operator=(AtomicFile&& other) noexcept {
  std::swap(path_, other.path_);
  std::swap(temporary_, other.temporary_);
  std::swap(options_, other.options_);
  std::swap(fd_, other.fd_);
  std::swap(slot_, other.slot_);
  return *this;
}

AtomicFile::~AtomicFile() {
  discard();
}

Status AtomicFile::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  const int error = detail::write_at(fd_, offset, bytes);
  if (error == 0) return {};
  return make_error(Errc::write_failed, offset, "cannot write the output", Error::kNone, Error::kNone, error);
}

Status AtomicFile::read_at(std::uint64_t offset, std::span<std::byte> bytes) const {
  const int error = detail::read_at(fd_, offset, bytes);
  if (error == 0) return {};
  return make_error(Errc::read_failed, offset, "cannot read the output back", Error::kNone, Error::kNone,
                    std::max(error, 0));
}

Status AtomicFile::copy_to_stdout() {
  const auto failed = [](Errc code, const char* what, int error) {
    return make_error(code, Error::kNone, what, Error::kNone, Error::kNone, error);
  };
  const auto collected = detail::status_of(fd_);
  if (!collected) return failed(Errc::read_failed, "cannot read the collected output", errno);
  std::vector<std::byte> buffer(std::size_t{1} << 20);
  for (std::uint64_t offset = 0; offset < collected->bytes;) {
    std::span<std::byte> part =
        std::span(buffer).first(std::min<std::uint64_t>(buffer.size(), collected->bytes - offset));
    if (const int error = detail::read_at(fd_, offset, part); error != 0)
      return failed(Errc::read_failed, "cannot read the collected output", std::max(error, 0));
    while (!part.empty()) {
      const auto written = ::write(STDOUT_FILENO, part.data(), static_cast<unsigned>(part.size()));
      if (written < 0 && errno == EINTR) continue;
      if (written <= 0) return failed(Errc::write_failed, "cannot write to standard output", errno);
      part = part.subspan(static_cast<std::size_t>(written));
    }
  }
  return {};
}

Result<double> AtomicFile::commit() {
  return detail::guard_memory([this]() -> Result<double> {
    for (const MappedFile* input : options_.inputs) {
      if (const Status s = input->check_unchanged(); !s) return tl::unexpected(s.error());
    }
    if (AtomicFile* const held = std::exchange(options_.hold, nullptr)) {
      *held = std::move(*this);
      return 0.0;
    }
    if (path_ == "-") {
      const Status copied = copy_to_stdout();
      discard();
      if (!copied) return tl::unexpected(copied.error());
      return 0.0;
    }
    return finish();
  });
}

}  // namespace rgs
