// stop_at_mapping.cpp - preloaded into a program: the program stops once it has mapped the file RGS_STOP_AT for the RGS_STOP_TIME-th time.
// SPDX-License-Identifier: Apache-2.0
#include <signal.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <atomic>
#include <cstdlib>

extern "C" void* mmap(void* at, std::size_t bytes, int protection, int flags, int fd, off_t offset) noexcept {
  void* const memory =
      reinterpret_cast<void*>(::syscall(SYS_mmap, at, bytes, protection, flags, fd, offset));  // -1: MAP_FAILED
  static std::atomic<int> n_mapped{0};
  const char* const path = ::getenv("RGS_STOP_AT");
  const char* const time = ::getenv("RGS_STOP_TIME");
  struct stat mapped {
  }, wanted{};
  if (fd >= 0 && memory != MAP_FAILED && path != nullptr && time != nullptr && ::fstat(fd, &mapped) == 0 &&
      ::stat(path, &wanted) == 0 && mapped.st_ino == wanted.st_ino && mapped.st_dev == wanted.st_dev &&
      ++n_mapped == ::atoi(time))
    ::kill(::getpid(), SIGSTOP);
  return memory;
}

extern "C" void* mmap64(void* at, std::size_t bytes, int protection, int flags, int fd, off64_t offset) noexcept {
  return ::mmap(at, bytes, protection, flags, fd, offset);
}
