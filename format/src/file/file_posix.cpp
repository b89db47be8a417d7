// file_posix.cpp - mapped input and all-or-nothing output on POSIX.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/file.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <climits>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <utility>
#include <vector>

#include "rgs/guard_memory.hpp"
#include "rgs/utf8_path.hpp"

namespace rgs {
namespace {

tl::unexpected<Error> system_error(Errc code, const char* what) {
  return make_error(code, Error::kNone, what, Error::kNone, Error::kNone, errno);
}

const char* const kStdout = "-";
constexpr const char* kTemporary = ".tmp-XXXXXX";
constexpr mode_t kUsualMode = 0666;            // less the umask
constexpr int kFirstFree = STDERR_FILENO + 1;  // a standard stream may be closed; its number must not become the file's

// Unfinished temporaries, for the signal handler: plain memory and lock-free flags only. state: 0 free, 1 being filled,
// 2 live.
struct Slot {
  std::atomic<int> state{0};
  char path[PATH_MAX];
};
constexpr int kSlots = 32;
Slot g_slots[kSlots];
static_assert(std::atomic<int>::is_always_lock_free);

int claim_slot(const std::string& path) {
  if (path.size() >= sizeof(Slot::path)) return -1;
  for (int i = 0; i < kSlots; ++i) {
    int expected = 0;
    if (!g_slots[i].state.compare_exchange_strong(expected, 1)) continue;
    std::memcpy(g_slots[i].path, path.c_str(), path.size() + 1);
    g_slots[i].state.store(2, std::memory_order_release);
    return i;
  }
  return -1;
}

void release_slot(int slot) {
  if (slot >= 0) g_slots[slot].state.store(0, std::memory_order_release);
}

// Signals that end a process by default. SIGPIPE: the reader of progress or results has closed the pipe.
constexpr int kEndingSignals[] = {SIGINT, SIGTERM, SIGHUP, SIGPIPE};

// Set by the first thread to read beyond a shrunken input; others then wait for its exit.
std::atomic_flag g_input_shrank;

// Writes to standard error, in a signal handler: what a terminal might obey as question marks.
void say(const char* text) {
  char buffer[256];
  std::size_t n = 0;
  for (; *text != '\0' && *text != '\n'; ++text) {
    buffer[n++] = *text >= ' ' && *text < 0x7f ? *text : '?';
    if (n < sizeof buffer && text[1] != '\0' && text[1] != '\n') continue;
    if (::write(STDERR_FILENO, buffer, n) < 0) return;
    n = 0;
  }
}

// Writes the path of the file that is mapped at `address`, by the system's list: "BEGIN-END RIGHTS OFFSET DEVICE INODE PATH".
void say_mapped_path(std::uintptr_t address) {
  static char line[PATH_MAX + 128];  // one thread comes here
  const int maps = ::open("/proc/self/maps", O_RDONLY | O_CLOEXEC);
  std::size_t n = 0;
  for (char c = 0; maps >= 0 && ::read(maps, &c, 1) == 1;) {
    if (n + 1 < sizeof line) line[n++] = c;
    if (c != '\n') continue;
    line[n - 1] = '\0';
    n = 0;
    char* end = nullptr;
    const std::uintptr_t first = std::strtoull(line, &end, 16), last = std::strtoull(end + 1, nullptr, 16);
    if (address < first || address >= last) continue;
    const char* const path = std::strchr(line, '/');
    say(path != nullptr ? path : "an input");
    return;
  }
  say("an input");
}

extern "C" void remove_temporaries_and_die(int signal_number, siginfo_t* info, void*) {
  while (signal_number == SIGBUS && g_input_shrank.test_and_set()) ::pause();
  for (Slot& slot : g_slots) {
    if (slot.state.load(std::memory_order_acquire) == 2) ::unlink(slot.path);
  }
  if (signal_number == SIGBUS) {
    // A mapped page has disappeared. Only MappedFile maps files, so an input (or its disk) shrank.
    say(program_invocation_short_name);
    say(": ");
    say_mapped_path(reinterpret_cast<std::uintptr_t>(info->si_addr));
    say(": shrank or became unreadable while it was being read [read_failed]");
    (void)!::write(STDERR_FILENO, "\n", 1);
    ::_exit(exit_code(Errc::read_failed));
  }
  // SA_RESETHAND has restored the default action: the process dies of the signal, as its parent expects.
  ::raise(signal_number);
}

tl::unexpected<Error> cannot_name() {
  if (errno == EEXIST) {
    return make_error(Errc::output_exists, Error::kNone,
                      "the output appeared meanwhile; pass --overwrite to replace it");
  }
  return system_error(Errc::write_failed, "cannot give the output its name");
}

std::string folder_of(const std::string& path) {
  const std::size_t slash = path.find_last_of('/');
  if (slash == std::string::npos) return ".";
  return slash == 0 ? "/" : path.substr(0, slash);
}

// Calls `make` with other letters for the Xs at the end of `name` until it has no reason but EEXIST to fail. Returns its
// result: -1 and errno if it failed.
template <class Make>
int with_new_name(std::string& name, const Make& make) {
  constexpr char kLetters[] = "abcdefghijklmnopqrstuvwxyz012345";
  constexpr int kAttempts = 100;
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    std::uint32_t random = 0;
    if (::getentropy(&random, sizeof random) != 0) return -1;
    for (std::size_t i = 1; i <= 6; ++i, random >>= 5) name[name.size() - i] = kLetters[random & 31u];
    const int made = make();
    if (made >= 0 || errno != EEXIST) return made;
  }
  return -1;
}

// Moves the descriptor above the standard streams' numbers; -1 and errno on failure.
int beyond_standard_streams(int fd) {
  if (fd < 0 || fd >= kFirstFree) return fd;
  const int moved = ::fcntl(fd, F_DUPFD_CLOEXEC, kFirstFree);
  const int error = errno;
  ::close(fd);
  errno = error;
  return moved;
}

// A file without a name: it is gone with its process, whatever ends that. -1 and errno where the file system has none.
int create_unnamed(const std::string& folder, mode_t mode) {
  return beyond_standard_streams(::open(folder.c_str(), O_TMPFILE | O_RDWR | O_CLOEXEC, mode));
}

// The name by which an open file is linked. linkat(AT_EMPTY_PATH) would need a capability.
std::string open_name(int fd) {
  return "/proc/self/fd/" + std::to_string(fd);
}

int link_open(int fd, const std::string& path) {
  return ::linkat(AT_FDCWD, open_name(fd).c_str(), AT_FDCWD, path.c_str(), AT_SYMLINK_FOLLOW);
}

// Gives a replacement the old file's permissions before its first byte.
void take_over_rights(int fd, const struct stat& old) {
  mode_t mode = old.st_mode & 0777;
  if (::fchown(fd, old.st_uid, old.st_gid) != 0 && ::fchown(fd, static_cast<uid_t>(-1), old.st_gid) != 0) {
    mode = (mode & 0707u) | (mode & 07u) << 3;  // another group gets the permissions of others
  }
  (void)::fchmod(fd, mode);  // ignores file systems without permissions
}

// Masks the handled signals while a temporary is created, so that none strikes between the file and its table entry.
class SignalGuard {
 public:
  SignalGuard() {
    sigset_t set;
    sigemptyset(&set);
    for (const int s : kEndingSignals) sigaddset(&set, s);
    pthread_sigmask(SIG_BLOCK, &set, &old_);
  }
  ~SignalGuard() { pthread_sigmask(SIG_SETMASK, &old_, nullptr); }
  SignalGuard(const SignalGuard&) = delete;
  SignalGuard& operator=(const SignalGuard&) = delete;

 private:
  sigset_t old_;
};

// All bytes by ::pwrite or ::pread; `ended` where it moves none. Returns 0, errno or that.
template <class Call, class Byte>
int transfer(Call call, int fd, std::uint64_t& offset, std::span<Byte> bytes, int ended) {
  while (!bytes.empty()) {
    const ssize_t n = call(fd, bytes.data(), bytes.size(), static_cast<off_t>(offset));
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) return n == 0 ? ended : errno;
    bytes = bytes.subspan(static_cast<std::size_t>(n));
    offset += static_cast<std::uint64_t>(n);
  }
  return 0;
}

detail::FileStatus status_from(const struct stat& info) {
  using detail::FileStatus;
  FileStatus status;
  status.kind = S_ISREG(info.st_mode)   ? FileStatus::Kind::regular
                : S_ISDIR(info.st_mode) ? FileStatus::Kind::folder
                                        : FileStatus::Kind::other;
  status.device = info.st_dev;
  status.inode = info.st_ino;
  status.bytes = static_cast<std::uint64_t>(info.st_size);
  status.n_names = info.st_nlink;
  status.modified = {info.st_mtim.tv_sec, info.st_mtim.tv_nsec};
  status.changed = {info.st_ctim.tv_sec, info.st_ctim.tv_nsec};
  return status;
}

}  // namespace

std::filesystem::path detail::path_of(std::string_view name) {
  return name;
}

std::optional<detail::FileStatus> detail::status_of(const std::string& path) {
  struct stat info {};
  if (::stat(path.c_str(), &info) != 0) return std::nullopt;
  return status_from(info);
}

std::optional<detail::FileStatus> detail::status_of(int fd) {
  struct stat info {};
  if (::fstat(fd, &info) != 0) return std::nullopt;
  return status_from(info);
}

int detail::open_to_read(const std::string& path, bool wait) {
  return beyond_standard_streams(::open(path.c_str(), O_RDONLY | O_CLOEXEC | (wait ? 0 : O_NONBLOCK)));
}

int detail::write_at(int fd, std::uint64_t& offset, std::span<const std::byte> bytes) {
  return transfer(::pwrite, fd, offset, bytes, ENOSPC);
}

int detail::read_at(int fd, std::uint64_t& offset, std::span<std::byte> bytes) {
  return transfer(::pread, fd, offset, bytes, kFileEnded);
}

int detail::open_scratch(const std::string& asked) {
  const char* const usual = std::getenv("TMPDIR");
  const std::string folder = !asked.empty() ? asked : usual != nullptr && *usual != '\0' ? usual : "/tmp";
  const SignalGuard guard;
  const int unnamed = create_unnamed(folder, 0600);
  if (unnamed >= 0) return unnamed;
  std::string name = folder + "/rgs-scratch-XXXXXX";
  const int named = ::mkostemp(name.data(), O_CLOEXEC);
  if (named >= 0) ::unlink(name.c_str());
  return beyond_standard_streams(named);
}

bool detail::make_scratch_folder(std::string& name) {
  return ::mkdtemp(name.data()) != nullptr;
}

std::string follow_links(const std::string& path) {
  constexpr int kMaxLinks = 40;  // the kernel's limit; a longer chain is a loop, and fails when it is opened
  std::string at = path;
  std::vector<char> target(PATH_MAX);
  for (int i = 0; i < kMaxLinks; ++i) {
    const ssize_t length = ::readlink(at.c_str(), target.data(), target.size());
    if (length <= 0 || static_cast<std::size_t>(length) == target.size()) return at;
    std::string next(target.data(), static_cast<std::size_t>(length));
    const std::size_t slash = at.find_last_of('/');
    if (next.front() != '/' && slash != std::string::npos) next.insert(0, at, 0, slash + 1);
    at = std::move(next);
  }
  return path;
}

Result<MappedFile> MappedFile::map(int fd) {
  const auto status = detail::status_of_regular(fd);
  if (!status) return tl::unexpected(status.error());
  MappedFile file;
  file.fd_ = ::fcntl(fd, F_DUPFD_CLOEXEC, kFirstFree);
  if (file.fd_ < 0) return system_error(Errc::open_failed, "cannot keep the file open");
  file.size_ = static_cast<std::size_t>(status->bytes);
  file.stamp_ = *status;
  if (file.size_ == 0) return file;  // mmap rejects length 0
  void* data = ::mmap(nullptr, file.size_, PROT_READ, MAP_PRIVATE, fd, 0);
  if (data == MAP_FAILED) return system_error(Errc::read_failed, "cannot map the file");
  file.data_ = static_cast<const std::byte*>(data);
  return file;
}

MappedFile::~MappedFile() {
  if (data_ != nullptr) ::munmap(const_cast<std::byte*>(data_), size_);
  if (fd_ >= 0) ::close(fd_);
}

void MappedFile::advise(Access access, std::uint64_t offset, std::uint64_t length) const {
  if (data_ == nullptr || offset >= size_) return;
  int advice = MADV_NORMAL;
  switch (access) {
    case Access::normal: advice = MADV_NORMAL; break;
    case Access::sequential: advice = MADV_SEQUENTIAL; break;
    case Access::random: advice = MADV_RANDOM; break;
    case Access::will_need: advice = MADV_WILLNEED; break;
    case Access::done: advice = MADV_DONTNEED; break;
  }
  const auto page = static_cast<std::uint64_t>(::sysconf(_SC_PAGESIZE));
  const std::uint64_t first = offset / page * page;
  const std::uint64_t last = offset + std::min<std::uint64_t>(length, size_ - offset);
  ::madvise(const_cast<std::byte*>(data_) + first, last - first, advice);
}

Result<AtomicFile> AtomicFile::begin(const std::string& name, const Options& options) {
  const std::string path = name == kStdout ? name : follow_links(name);
  struct stat info {};
  // Uses the name itself: links below /proc lead to pipes too, which have no other name.
  const bool replaces = path != kStdout && ::stat(name.c_str(), &info) == 0;
  if (path != kStdout && !replaces && errno == ELOOP)
    return system_error(Errc::output_unusable, "the output's name is a link that leads back to itself");
  if (replaces) {
    if (S_ISDIR(info.st_mode)) return make_error(Errc::output_unusable, Error::kNone, "the output is a directory");
    if (!S_ISREG(info.st_mode))
      return make_error(Errc::output_unusable, Error::kNone, "the output is not a regular file");
    if (!options.overwrite) {
      return make_error(Errc::output_exists, Error::kNone, "the output exists already; pass --overwrite to replace it");
    }
  }
  AtomicFile file;
  file.path_ = path;
  file.options_ = options;
  if (path == kStdout) {
    file.fd_ = detail::open_scratch({});
    if (file.fd_ < 0)
      return system_error(Errc::write_failed, "cannot create a temporary file; set TMPDIR to a writable folder");
    return file;
  }
  file.fd_ = create_unnamed(folder_of(path), kUsualMode);
  if (file.fd_ < 0 || ::access(open_name(file.fd_).c_str(), F_OK) != 0) {
    file.discard();
    const SignalGuard guard;
    std::string temporary = path + kTemporary;
    // mkostemp() would set mode 0600, and the umask cannot be read without setting it; open() applies it, or the
    // folder's ACL.
    file.fd_ = with_new_name(
        temporary, [&] { return ::open(temporary.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, kUsualMode); });
    if (file.fd_ < 0) return system_error(Errc::write_failed, "cannot create a file in the output's folder");
    file.take_name(std::move(temporary));
    file.fd_ = beyond_standard_streams(file.fd_);
    if (file.fd_ < 0) return system_error(Errc::write_failed, "cannot create a file in the output's folder");
  }
  if (replaces) take_over_rights(file.fd_, info);
  return file;
}

void AtomicFile::take_name(std::string name) {
  temporary_ = std::move(name);
  slot_ = claim_slot(temporary_);
}

void AtomicFile::discard() {
  if (fd_ >= 0) ::close(fd_);
  fd_ = -1;
  if (!temporary_.empty()) ::unlink(temporary_.c_str());
  temporary_.clear();
  release_slot(std::exchange(slot_, -1));
}

Status AtomicFile::reserve(std::uint64_t size) {
  if (size == 0) return {};
  const int error = ::posix_fallocate(fd_, 0, static_cast<off_t>(size));
  // no reservation on this file system: writes will tell
  if (error == 0 || error == EOPNOTSUPP || error == EINVAL) return {};
  return make_error(Errc::write_failed, Error::kNone, "cannot reserve space for the output", size, Error::kNone, error);
}

Status AtomicFile::truncate(std::uint64_t size) {
  if (::ftruncate(fd_, static_cast<off_t>(size)) == 0) return {};
  return system_error(Errc::write_failed, "cannot set the size of the output");
}

Result<double> AtomicFile::finish() {
  const std::string folder_path = folder_of(path_);  // now: nothing may fail after renaming
  double seconds = 0;
  const auto timed_sync = [&seconds](int fd) {
    const auto start = std::chrono::steady_clock::now();
    const int status = ::fsync(fd);
    seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return status == 0;
  };
  if (options_.sync && !timed_sync(fd_)) return system_error(Errc::write_failed, "cannot sync the output");
  // Some file systems report a failed write on closing alone, which must come before the name.
  const int copy = ::fcntl(fd_, F_DUPFD_CLOEXEC, kFirstFree);
  if (copy < 0 || ::close(copy) != 0) return system_error(Errc::write_failed, "cannot close the output");
  if (temporary_.empty()) {
    const bool linked = link_open(fd_, path_) == 0;
    if (!linked && (errno != EEXIST || !options_.overwrite)) return cannot_name();
    // Only a rename replaces a file in one step, and it needs a name to start from.
    if (!linked) {
      const SignalGuard guard;
      std::string name = path_ + kTemporary;
      if (with_new_name(name, [&] { return link_open(fd_, name); }) < 0) return cannot_name();
      take_name(std::move(name));
    }
  }
  if (!temporary_.empty()) {
    const unsigned flags = options_.overwrite ? 0 : RENAME_NOREPLACE;
    if (::renameat2(AT_FDCWD, temporary_.c_str(), AT_FDCWD, path_.c_str(), flags) != 0) {
      // For file systems without RENAME_NOREPLACE: a hard link rejects an existing name too.
      if (flags == 0 || (errno != EINVAL && errno != ENOSYS)) return cannot_name();
      if (::link(temporary_.c_str(), path_.c_str()) != 0) return cannot_name();
      ::unlink(temporary_.c_str());
    }
  }
  ::close(std::exchange(fd_, -1));
  temporary_.clear();
  release_slot(std::exchange(slot_, -1));
  if (options_.sync) {
    const int folder = ::open(folder_path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (folder >= 0) {
      timed_sync(folder);  // some file systems cannot sync a folder; the file itself is on disk
      ::close(folder);
    }
  }
  return seconds;
}

void remove_temporaries_on_signal() {
  struct sigaction action {};
  action.sa_sigaction = remove_temporaries_and_die;
  action.sa_flags = static_cast<int>(SA_RESETHAND | SA_NODEFER | SA_SIGINFO);
  sigemptyset(&action.sa_mask);
  for (const int s : kEndingSignals) {
    struct sigaction inherited {};
    // Keeps signals ignored that nohup or a shell's background job ignores.
    if (::sigaction(s, nullptr, &inherited) == 0 && inherited.sa_handler != SIG_IGN) ::sigaction(s, &action, nullptr);
  }
  action.sa_flags =
      SA_SIGINFO;  // SA_RESETHAND would let a second thread's SIGBUS end the process before the first one's exit
  ::sigaction(SIGBUS, &action, nullptr);
  ::signal(SIGXFSZ, SIG_IGN);  // a write beyond the size limit (ulimit -f) then fails with EFBIG
}

}  // namespace rgs
