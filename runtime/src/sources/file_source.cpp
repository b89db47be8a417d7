// file_source.cpp - a file on a disk, read by pread(): if the file shrinks, that is an error, where a mapping would
// raise a signal.
// SPDX-License-Identifier: Apache-2.0
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <thread>

#include "rgs/byte_source.hpp"
#include "rgs/file.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

constexpr std::size_t kPieceBytes = 4 << 20;  // between checks for cancellation
constexpr unsigned kMostThreads = 16;         // as many as keep one disk busy

tl::unexpected<Error> system_error(Errc code, std::uint64_t offset, const char* what) {
  return make_error(code, offset, what, Error::kNone, Error::kNone, errno);
}

class FileSource final : public ByteSource {
 public:
  FileSource(int fd, const detail::FileStatus& at_open) : fd_(fd), at_open_(at_open) {}
  ~FileSource() override { ::close(fd_); }
  FileSource(const FileSource&) = delete;
  FileSource& operator=(const FileSource&) = delete;

  std::uint64_t size() const override { return at_open_.bytes; }

  Status read(std::uint64_t offset, std::span<std::byte> out) override {
    if (offset > size() || out.size() > size() - offset) {
      return make_error(Errc::read_failed, offset, "the file ends before the requested range", out.size(),
                        size() - std::min(offset, size()));
    }
    const std::uint64_t begin = offset;
    while (!out.empty()) {
      if (cancelled_) return make_error(Errc::cancelled, offset, "reading was cancelled");
      const std::span<std::byte> piece = out.first(std::min(out.size(), kPieceBytes));
      const int error = detail::read_at(fd_, offset, piece);
      if (error == detail::kFileEnded) return changed(offset);
      if (error != 0)
        return make_error(Errc::read_failed, offset, "cannot read the file", Error::kNone, Error::kNone, error);
      out = out.subspan(piece.size());
    }
    if (cancelled_) return make_error(Errc::cancelled, begin, "reading was cancelled");
    // After the read: a write before it shows in the times by then.
    return check_unchanged(begin);
  }

  void cancel() noexcept override { cancelled_ = true; }

  Traits traits() const override {
    Traits traits;
    // Leaves a processor to the thread that draws: without one it waits for the readers, and they for its locks. At
    // least four readers, which a disk needs, even with four processors or fewer.
    const unsigned n = std::max(std::thread::hardware_concurrency(), 1U) - 1;
    traits.reads_at_once = static_cast<int>(std::clamp(n, 4U, kMostThreads));
    return traits;
  }

 private:
  static tl::unexpected<Error> changed(std::uint64_t offset) {
    return make_error(Errc::read_failed, offset, "the file changed while it was read; open it again");
  }

  // As MappedFile::check_unchanged().
  Status check_unchanged(std::uint64_t offset) const {
    const auto now = detail::status_of(fd_);
    if (!now) return system_error(Errc::read_failed, offset, "cannot read the file's size");
    if (!at_open_.is_unchanged(*now)) return changed(offset);
    return {};
  }

  const int fd_;
  const detail::FileStatus at_open_;
  std::atomic<bool> cancelled_{false};
};

}  // namespace

Result<std::unique_ptr<ByteSource>> open_file_source(const std::string& path) {
  return detail::guard_memory([&]() -> Result<std::unique_ptr<ByteSource>> {
    const int fd = detail::open_to_read(path, false);
    if (fd < 0) return system_error(Errc::open_failed, Error::kNone, "cannot open for reading");
    struct Closer {
      int fd;
      ~Closer() {
        if (fd >= 0) ::close(fd);
      }
    } closer{fd};
    const auto status = detail::status_of_regular(fd);
    if (!status) return tl::unexpected(status.error());
    auto source = std::make_unique<FileSource>(fd, *status);
    closer.fd = -1;
    return source;
  });
}

}  // namespace rgs
