// file_source.cpp - a file on a disk, read by pread(): if the file shrinks, that is an error, where a mapping would
// raise a signal.
// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <thread>

#include "rgs/byte_source.hpp"
#include "rgs/guard_memory.hpp"

namespace rgs {
namespace {

constexpr std::size_t kPieceBytes = 4 << 20;   // between checks for cancellation
constexpr int kFirstFree = STDERR_FILENO + 1;  // a standard stream may be closed; its number must not become the file's
constexpr unsigned kMostThreads = 16;          // as many as keep one disk busy

tl::unexpected<Error> system_error(Errc code, std::uint64_t offset, const char* what) {
  return make_error(code, offset, what, Error::kNone, Error::kNone, errno);
}

bool same_time(const timespec& a, const timespec& b) {
  return a.tv_sec == b.tv_sec && a.tv_nsec == b.tv_nsec;
}

class FileSource final : public ByteSource {
 public:
  FileSource(int fd, const struct stat& at_open) : fd_(fd), at_open_(at_open) {}
  ~FileSource() override { ::close(fd_); }
  FileSource(const FileSource&) = delete;
  FileSource& operator=(const FileSource&) = delete;

  std::uint64_t size() const override { return static_cast<std::uint64_t>(at_open_.st_size); }

  Status read(std::uint64_t offset, std::span<std::byte> out) override {
    if (offset > size() || out.size() > size() - offset) {
      return make_error(Errc::read_failed, offset, "the file ends before the requested range", out.size(),
                        size() - std::min(offset, size()));
    }
    for (std::size_t done = 0; done < out.size();) {
      if (cancelled_) return make_error(Errc::cancelled, offset + done, "reading was cancelled");
      const ssize_t n =
          ::pread(fd_, out.data() + done, std::min(out.size() - done, kPieceBytes), static_cast<off_t>(offset + done));
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) return system_error(Errc::read_failed, offset + done, "cannot read the file");
      if (n == 0) return changed(offset + done);
      done += static_cast<std::size_t>(n);
    }
    if (cancelled_) return make_error(Errc::cancelled, offset, "reading was cancelled");
    // After the read: a write before it shows in the times by then.
    return check_unchanged(offset);
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
    struct stat now {};
    if (::fstat(fd_, &now) != 0) return system_error(Errc::read_failed, offset, "cannot read the file's size");
    if (now.st_size != at_open_.st_size || !same_time(now.st_mtim, at_open_.st_mtim)) return changed(offset);
    // A writer may reset the time of modification, but not that of change. Making or removing a link changes that too,
    // and does no harm.
    if (!same_time(now.st_ctim, at_open_.st_ctim) && now.st_nlink == at_open_.st_nlink) return changed(offset);
    return {};
  }

  const int fd_;
  const struct stat at_open_;
  std::atomic<bool> cancelled_{false};
};

}  // namespace

Result<std::unique_ptr<ByteSource>> open_file_source(const std::string& path) {
  return detail::guard_memory([&]() -> Result<std::unique_ptr<ByteSource>> {
    // O_NONBLOCK: a FIFO is rejected below instead of blocking here.
    const int opened = ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (opened < 0) return system_error(Errc::open_failed, Error::kNone, "cannot open for reading");
    const int fd = ::fcntl(opened, F_DUPFD_CLOEXEC, kFirstFree);
    const int error = errno;
    ::close(opened);
    errno = error;
    if (fd < 0) return system_error(Errc::open_failed, Error::kNone, "cannot keep the file open");
    struct Closer {
      int fd;
      ~Closer() {
        if (fd >= 0) ::close(fd);
      }
    } closer{fd};
    struct stat info {};
    if (::fstat(fd, &info) != 0) return system_error(Errc::open_failed, Error::kNone, "cannot read the file's size");
    if (S_ISDIR(info.st_mode)) return make_error(Errc::open_failed, Error::kNone, "is a directory, not a file");
    if (!S_ISREG(info.st_mode)) return make_error(Errc::open_failed, Error::kNone, "is not a regular file");
    auto source = std::make_unique<FileSource>(fd, info);
    closer.fd = -1;
    return source;
  });
}

}  // namespace rgs
