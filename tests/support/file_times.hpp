// file_times.hpp - makes changes of files visible in their times, however coarse the file system's clock.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <stdexcept>
#include <string>
#include <utility>

namespace rgs::test {

/// Returns once a change of `path` would get a later time than its last one, judged by a file beside it.
inline void wait_for_later_time(const std::string& path) {
  const auto changed_at = [](const std::string& file) {
    struct stat info {};
    if (::stat(file.c_str(), &info) != 0) throw std::runtime_error("no such file: " + file);
    return std::pair(info.st_ctim.tv_sec, info.st_ctim.tv_nsec);
  };
  const std::string probe = path + ".probe";
  ::close(::open(probe.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, 0600));
  while (changed_at(probe) <= changed_at(path)) ::utimensat(AT_FDCWD, probe.c_str(), nullptr, 0);
  ::unlink(probe.c_str());
}

}  // namespace rgs::test
