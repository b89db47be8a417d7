// injected_faults.cpp - preloaded into a program: its calls of libc that write files, or that start threads, fail or kill
// it at a chosen count.
// SPDX-License-Identifier: Apache-2.0
//
// RGS_FAULT_AT=N: the Nth call that changes a file or folder and all later ones fail with ENOSPC as on a full disk, where a
//                 full disk lets them fail. With RGS_FAULT_KILLS=1 the program is killed by SIGKILL before the Nth instead.
// RGS_NO_UNNAMED_FILES=1: as on a file system without O_TMPFILE.
// RGS_MOST_THREADS=N: N threads run beside the first; more fail with EAGAIN.
//
// Calls are counted within a process; a forked child goes on from its parent's count.
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdarg>
#include <cstdlib>
#include <limits>

namespace {

long number(const char* variable, long otherwise) {
  const char* const text = std::getenv(variable);
  return text == nullptr ? otherwise : std::atol(text);
}

// The function that this one stands in front of.
template <class Function>
Function* next(const char* name, Function*) {
  return reinterpret_cast<Function*>(::dlsym(RTLD_NEXT, name));
}

// Counts a call that changes a file. True if it must fail for lack of room.
bool fails(bool needs_room) {
  static const long at = number("RGS_FAULT_AT", std::numeric_limits<long>::max());
  static const bool kills = number("RGS_FAULT_KILLS", 0) != 0;
  static std::atomic<long> count{0};
  if (++count < at) return false;
  if (kills) ::raise(SIGKILL);
  if (needs_room) errno = ENOSPC;
  return needs_room;
}

bool is_file(int fd) {
  struct stat info {};
  return ::fstat(fd, &info) == 0 && S_ISREG(info.st_mode);
}

bool is_unnamed(int flags) {
  return (flags & O_TMPFILE) == O_TMPFILE;
}

bool may_open(int flags) {
  if (is_unnamed(flags) && number("RGS_NO_UNNAMED_FILES", 0) != 0) {
    errno = EOPNOTSUPP;
    return false;
  }
  return (!is_unnamed(flags) && (flags & O_CREAT) == 0) || !fails(true);
}

std::atomic<long> g_threads{0};  // that run

struct Start {
  void* (*body)(void*);
  void* argument;
};

void* run_thread(void* started) {
  const Start start = *static_cast<Start*>(started);
  delete static_cast<Start*>(started);
  void* const result = start.body(start.argument);
  --g_threads;
  return result;
}

}  // namespace

#define RGS_NEXT(name) static auto* const real = next(#name, &::name)

extern "C" {

int open(const char* path, int flags, ...) {
  RGS_NEXT(open);
  va_list more;
  va_start(more, flags);
  const mode_t mode = (flags & O_CREAT) != 0 || is_unnamed(flags) ? va_arg(more, mode_t) : 0;
  va_end(more);
  return may_open(flags) ? real(path, flags, mode) : -1;
}
int mkostemp(char* path, int flags) {
  RGS_NEXT(mkostemp);
  return fails(true) ? -1 : real(path, flags);
}
int mkdir(const char* path, mode_t mode) noexcept {
  RGS_NEXT(mkdir);
  return fails(true) ? -1 : real(path, mode);
}
ssize_t write(int fd, const void* bytes, size_t n) {
  RGS_NEXT(write);
  return is_file(fd) && fails(true) ? -1 : real(fd, bytes, n);
}
ssize_t pwrite(int fd, const void* bytes, size_t n, off_t offset) {
  RGS_NEXT(pwrite);
  return fails(true) ? -1 : real(fd, bytes, n, offset);
}
int posix_fallocate(int fd, off_t offset, off_t n) {
  RGS_NEXT(posix_fallocate);
  return fails(true) ? ENOSPC : real(fd, offset, n);
}
int fsync(int fd) {
  RGS_NEXT(fsync);
  return fails(true) ? -1 : real(fd);
}
int ftruncate(int fd, off_t n) noexcept {
  RGS_NEXT(ftruncate);
  return fails(false) ? -1 : real(fd, n);
}
int link(const char* from, const char* to) noexcept {
  RGS_NEXT(link);
  return fails(true) ? -1 : real(from, to);
}
int linkat(int from_folder, const char* from, int to_folder, const char* to, int flags) noexcept {
  RGS_NEXT(linkat);
  return fails(true) ? -1 : real(from_folder, from, to_folder, to, flags);
}
int renameat2(int from_folder, const char* from, int to_folder, const char* to, unsigned flags) noexcept {
  RGS_NEXT(renameat2);
  return fails(false) ? -1 : real(from_folder, from, to_folder, to, flags);
}
int rename(const char* from, const char* to) noexcept {
  RGS_NEXT(rename);
  return fails(false) ? -1 : real(from, to);
}
int unlink(const char* path) noexcept {
  RGS_NEXT(unlink);
  return fails(false) ? -1 : real(path);
}
int close(int fd) {
  RGS_NEXT(close);
  if (is_file(fd)) fails(false);
  return real(fd);
}

int pthread_create(pthread_t* thread, const pthread_attr_t* attributes, void* (*body)(void*), void* argument) {
  RGS_NEXT(pthread_create);
  static const long most = number("RGS_MOST_THREADS", std::numeric_limits<long>::max());
  if (++g_threads > most) {
    --g_threads;
    return EAGAIN;
  }
  auto* const start = new Start{body, argument};
  const int error = real(thread, attributes, run_thread, start);
  if (error != 0) {
    --g_threads;
    delete start;
  }
  return error;
}

}  // extern "C"
