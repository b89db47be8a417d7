// system_posix.cpp - names, streams and limits on Linux.
// SPDX-License-Identifier: Apache-2.0
#include <errno.h>  // program_invocation_short_name
#include <fcntl.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstring>

#include "console.hpp"
#include "system.hpp"

namespace rgs::tool {

const char* program_name() {
  return program_invocation_short_name;
}

std::vector<std::string> arguments_of(int argc, const char* const* argv) {
  return {argv, argv + argc};
}

void prepare_standard_streams() {
  // The placeholders fail reads and writes with EBADF, as a closed stream does.
  for (const int fd : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) {
    if (::fcntl(fd, F_GETFD) < 0 && errno == EBADF && ::open("/", O_PATH) != fd) ::_exit(kInputOutput);
  }
}

void ignore_closed_pipes() {
  std::signal(SIGPIPE, SIG_IGN);
}

const char* error_text(int error) {
  return ::strerrordesc_np(error);
}

void allow_open_files(std::size_t n) {
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit) != 0 || limit.rlim_cur >= n) return;
  limit.rlim_cur = std::min<rlim_t>(limit.rlim_max, n);
  (void)::setrlimit(RLIMIT_NOFILE, &limit);
}

}  // namespace rgs::tool
