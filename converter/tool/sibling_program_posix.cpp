// sibling_program_posix.cpp - /proc/self/exe and posix_spawn.
// SPDX-License-Identifier: Apache-2.0
#include "sibling_program.hpp"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>  // environ, with GNU extensions (the default of g++ and clang++)

#include <cerrno>
#include <filesystem>

namespace rgs::tool {

Result<std::string> program_folder() {
  std::error_code failed;
  const auto self = std::filesystem::read_symlink("/proc/self/exe", failed);
  if (failed)
    return make_error(Errc::open_failed, Error::kNone, "cannot find the program's own folder", Error::kNone,
                      Error::kNone, failed.value());
  return self.parent_path().string();
}

Result<std::string> sibling_program(const std::string& name) {
  return program_folder().and_then([&](const std::string& folder) -> Result<std::string> {
    std::string path = (std::filesystem::path(folder) / name).string();
    if (::access(path.c_str(), X_OK) != 0)
      return make_error(Errc::open_failed, Error::kNone,
                        "the program is not beside this one; install both into one folder", Error::kNone, Error::kNone,
                        errno);
    return path;
  });
}

Result<int> run_program_and_wait(const std::string& path, const std::vector<std::string>& arguments, int output) {
  std::vector<char*> argv{const_cast<char*>(path.c_str())};
  for (const std::string& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
  argv.push_back(nullptr);
  pid_t id = 0;
  posix_spawn_file_actions_t actions;
  int error = ::posix_spawn_file_actions_init(&actions);
  if (error == 0) {
    error = ::posix_spawn_file_actions_adddup2(&actions, output, STDOUT_FILENO);
    if (error == 0) error = ::posix_spawn(&id, path.c_str(), &actions, nullptr, argv.data(), environ);
    ::posix_spawn_file_actions_destroy(&actions);
  }
  if (error != 0)
    return make_error(Errc::internal, Error::kNone, "cannot start the program", Error::kNone, Error::kNone, error);
  int status = 0;
  while (::waitpid(id, &status, 0) < 0) {
    if (errno != EINTR)
      return make_error(Errc::internal, Error::kNone, "cannot wait for the program", Error::kNone, Error::kNone, errno);
  }
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

NameForPrograms::NameForPrograms(int fd) : inherited_(::fcntl(fd, F_DUPFD, STDERR_FILENO + 1)) {
  if (inherited_ >= 0) path_ = "/dev/fd/" + std::to_string(inherited_);
}

NameForPrograms::~NameForPrograms() {
  if (inherited_ >= 0) ::close(inherited_);
}

}  // namespace rgs::tool
