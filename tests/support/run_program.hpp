// run_program.hpp - child processes of a test: start, signal, wait, and read their output.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <cstdlib>
#include <functional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "checkout.hpp"

namespace rgs::test {

/// The path of a program of this build.
inline std::string built(const std::string& program) {
  return binary_dir() + "/bin/" + program;
}

struct ProgramResult {
  int exit_code = -1;  ///< -1 if a signal ended it
  int signal = 0;
  std::string out, err;
};

/// A running child; killed and reaped at the latest by the destructor.
class Program {
 public:
  /// arguments[0] is the path. `before_exec` runs in the child. Standard input is empty. Exit code 127: cannot execute.
  explicit Program(const std::vector<std::string>& arguments, const std::function<void()>& before_exec = {})
      : out_(::memfd_create("stdout", MFD_CLOEXEC)), err_(::memfd_create("stderr", MFD_CLOEXEC)) {
    std::vector<char*> argv;
    for (const std::string& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
    argv.push_back(nullptr);
    id_ = out_ < 0 || err_ < 0 ? -1 : ::fork();
    if (id_ < 0) throw std::runtime_error("cannot start a process");
    if (id_ != 0) return;
    ::dup2(::open("/dev/null", O_RDONLY), STDIN_FILENO);
    ::dup2(out_, STDOUT_FILENO);
    ::dup2(err_, STDERR_FILENO);
    // Test runners ignore some signals, and exec keeps that.
    for (const int s : {SIGINT, SIGTERM, SIGHUP, SIGPIPE, SIGXFSZ}) ::signal(s, SIG_DFL);
    if (before_exec) before_exec();
    ::execv(argv[0], argv.data());
    ::_exit(127);
  }
  ~Program() {
    if (id_ > 0) {
      ::kill(id_, SIGKILL);
      reap();
    }
    ::close(out_);
    ::close(err_);
  }
  Program(const Program&) = delete;
  Program& operator=(const Program&) = delete;

  pid_t id() const { return id_; }
  /// True until the child has ended; it stays a zombie, so that its id is not reused.
  bool running() const {
    siginfo_t info{};
    return ::waitid(P_PID, static_cast<id_t>(id_), &info, WEXITED | WNOHANG | WNOWAIT) == 0 && info.si_pid == 0;
  }
  /// Waits until the child has stopped itself (true) or ended.
  bool stops() const {
    siginfo_t info{};
    ::waitid(P_PID, static_cast<id_t>(id_), &info, WEXITED | WSTOPPED | WNOWAIT);
    return info.si_code == CLD_STOPPED;
  }
  /// Signals the child; harmless if it has ended.
  void send(int signal_number) const { ::kill(id_, signal_number); }

  /// Its standard output so far.
  std::string out() const { return contents(out_); }

  ProgramResult wait() {
    const int status = reap();
    ProgramResult result;
    if (WIFEXITED(status)) result.exit_code = WEXITSTATUS(status);
    if (WIFSIGNALED(status)) result.signal = WTERMSIG(status);
    result.out = contents(out_);
    result.err = contents(err_);
    return result;
  }

 private:
  int reap() {
    int status = 0;
    while (::waitpid(id_, &status, 0) < 0 && errno == EINTR) {
    }
    id_ = -1;
    return status;
  }
  // The file offset stays: the child writes there.
  static std::string contents(int fd) {
    struct stat info {};
    if (::fstat(fd, &info) != 0) return {};
    std::string text(static_cast<std::size_t>(info.st_size), '\0');
    const ssize_t n = ::pread(fd, text.data(), text.size(), 0);
    text.resize(n > 0 ? static_cast<std::size_t>(n) : 0);
    return text;
  }

  int out_, err_;
  pid_t id_ = -1;
};

/// For `before_exec`: the program sends itself `signal_number` once `stage` has done that many units (console.hpp).
inline std::function<void()> failpoint(const std::string& stage, std::uint64_t units = 0, int signal_number = SIGSTOP) {
  return [value = stage + ":" + std::to_string(units) + ":" + std::to_string(signal_number)] {
    ::setenv("RGS_FAILPOINT", value.c_str(), 1);
  };
}

inline ProgramResult run_program(const std::vector<std::string>& arguments,
                                 const std::function<void()>& before_exec = {}) {
  return Program(arguments, before_exec).wait();
}

/// Runs `line` in a shell. The exit code is that of its last command.
inline ProgramResult run_shell(const std::string& line) {
  return run_program({"/bin/sh", "-c", line});
}

}  // namespace rgs::test
