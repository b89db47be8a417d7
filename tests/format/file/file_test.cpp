// file_test.cpp - mapped input and all-or-nothing output.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/file.hpp"

#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <csignal>
#include <cstdarg>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "file_times.hpp"
#include "temporary_folder.hpp"

namespace fs = std::filesystem;
using rgs::AtomicFile;
using rgs::Errc;
using rgs::MappedFile;
using rgs::test::TemporaryFolder;

namespace {

std::span<const std::byte> as_bytes(const std::string& text) {
  return std::as_bytes(std::span(text));
}

std::string contents(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

std::size_t entries(const fs::path& folder) {
  return static_cast<std::size_t>(std::distance(fs::directory_iterator(folder), fs::directory_iterator()));
}

int g_umask_calls = 0;
bool g_has_unnamed = true;

/// Runs `test` with outputs that have no name until the end, and as on a file system that has no such files.
template <class Test>
void with_and_without_unnamed_files(const Test& test) {
  for (const bool unnamed : {true, false}) {
    CAPTURE(unnamed);
    g_has_unnamed = unnamed;
    test(unnamed);
    g_has_unnamed = true;
  }
}

}  // namespace

// Replaces libc's in this program.
extern "C" int open(const char* path, int flags, ...) {
  if ((flags & O_TMPFILE) == O_TMPFILE && !g_has_unnamed) {
    errno = EOPNOTSUPP;
    return -1;
  }
  va_list more;
  va_start(more, flags);
  const unsigned mode = (flags & O_CREAT) != 0 || (flags & O_TMPFILE) == O_TMPFILE ? va_arg(more, unsigned) : 0;
  va_end(more);
  return static_cast<int>(::syscall(SYS_openat, AT_FDCWD, path, flags, mode));
}

// Replaces libc's in this program: whoever queries the umask this way sets it for all threads meanwhile.
extern "C" mode_t umask(mode_t mask) noexcept {
  ++g_umask_calls;
  return static_cast<mode_t>(::syscall(SYS_umask, mask));
}

TEST_CASE("an output has the umask's mode, and the library never touches the umask") {
  with_and_without_unnamed_files([](bool) {
    const TemporaryFolder folder;
    for (const mode_t mask : {0022U, 0027U, 0077U, 0002U}) {
      CAPTURE(mask);
      const std::string path = folder.file("out");
      fs::remove(path);  // a replaced file would keep its mode
      const mode_t before = ::umask(mask);
      const int calls = g_umask_calls;
      auto file = AtomicFile::create(path, {.overwrite = true, .sync = false});
      const bool committed = file && file->commit();
      CHECK(g_umask_calls == calls);
      ::umask(before);
      REQUIRE(committed);
      struct stat info {};
      REQUIRE(::stat(path.c_str(), &info) == 0);
      CHECK((info.st_mode & 07777) == (0666U & ~mask));
    }
  });
}

TEST_CASE("a mapped file shows the bytes, and distinguishes empty from missing and folder inputs") {
  const TemporaryFolder folder;
  std::ofstream(folder.file("a")) << "splat";
  std::ofstream(folder.file("empty"));
  const auto a = MappedFile::open(folder.file("a"));
  REQUIRE(a);
  CHECK(a->bytes().size() == 5);
  CHECK(std::memcmp(a->bytes().data(), "splat", 5) == 0);
  const auto empty = MappedFile::open(folder.file("empty"));
  REQUIRE(empty);
  CHECK(empty->bytes().empty());
  const auto missing = MappedFile::open(folder.file("none"));
  REQUIRE_FALSE(missing);
  CHECK(missing.error().code == Errc::open_failed);
  CHECK(missing.error().system == ENOENT);
  const auto directory = MappedFile::open(folder.path().string());
  REQUIRE_FALSE(directory);
  CHECK(directory.error().code == Errc::open_failed);
}

TEST_CASE("an output appears on commit and not before; without commit nothing stays") {
  with_and_without_unnamed_files([](bool unnamed) {
    const TemporaryFolder folder;
    const std::string path = folder.file("out");
    {
      auto file = AtomicFile::create(path, {});
      REQUIRE(file);
      REQUIRE(file->write_at(3, as_bytes("def")));
      REQUIRE(file->write_at(0, as_bytes("abc")));
      CHECK(entries(folder.path()) == (unnamed ? 0 : 1));
      CHECK_FALSE(fs::exists(path));
      REQUIRE(file->commit());
      CHECK(contents(path) == "abcdef");
      CHECK(entries(folder.path()) == 1);
    }
    {
      auto file = AtomicFile::create(path, {.overwrite = true, .sync = false});
      REQUIRE(file);
      REQUIRE(file->write_at(0, as_bytes("half")));
    }
    CHECK(contents(path) == "abcdef");
    CHECK(entries(folder.path()) == 1);
  });
}

TEST_CASE("a held output appears when its holder commits it, and the one held before is gone") {
  with_and_without_unnamed_files([](bool unnamed) {
    const TemporaryFolder folder;
    const std::string path = folder.file("out");
    {
      AtomicFile held;
      for (const char* text : {"first", "second"}) {
        auto file = AtomicFile::create(path, {.hold = &held});
        REQUIRE(file);
        REQUIRE(file->write_at(0, as_bytes(text)));
        REQUIRE(file->commit());
        CHECK_FALSE(fs::exists(path));
      }
      CHECK(entries(folder.path()) == (unnamed ? 0 : 1));
      REQUIRE(held.commit());
    }
    CHECK(contents(path) == "second");
    CHECK(entries(folder.path()) == 1);
  });
}

TEST_CASE("an existing output is kept unless overwriting is requested, also when it appears late") {
  with_and_without_unnamed_files([](bool) {
    const TemporaryFolder folder;
    const std::string path = folder.file("out");
    auto late = AtomicFile::create(path, {});
    REQUIRE(late);
    std::ofstream(path) << "first";
    const auto refused = AtomicFile::create(path, {});
    REQUIRE_FALSE(refused);
    CHECK(refused.error().code == Errc::output_exists);
    const auto committed = late->commit();
    REQUIRE_FALSE(committed);
    CHECK(committed.error().code == Errc::output_exists);
    CHECK(contents(path) == "first");
    auto replace = AtomicFile::create(path, {.overwrite = true, .sync = true});
    REQUIRE(replace);
    REQUIRE(replace->write_at(0, as_bytes("second")));
    REQUIRE(replace->commit());
    CHECK(contents(path) == "second");
  });
}

TEST_CASE("folders and missing folders are refused as outputs") {
  const TemporaryFolder folder;
  const auto directory = AtomicFile::create(folder.path().string(), {.overwrite = true});
  REQUIRE_FALSE(directory);
  CHECK(directory.error().code == Errc::output_unusable);
  const auto nowhere = AtomicFile::create(folder.file("none/out"), {});
  REQUIRE_FALSE(nowhere);
  CHECK(nowhere.error().code == Errc::write_failed);
}

TEST_CASE("moving an output keeps exactly one owner of the temporary") {
  with_and_without_unnamed_files([](bool unnamed) {
    const TemporaryFolder folder;
    auto a = AtomicFile::create(folder.file("a"), {});
    REQUIRE(a);
    AtomicFile b = std::move(*a);
    CHECK(entries(folder.path()) == (unnamed ? 0 : 1));
    REQUIRE(b.write_at(0, as_bytes("x")));
    b = AtomicFile();
    CHECK(entries(folder.path()) == 0);
  });
}

TEST_CASE("a signal ends the process, and leaves no unfinished output") {
  with_and_without_unnamed_files([](bool unnamed) {
    for (const int signal_number : {SIGINT, SIGTERM, SIGHUP, SIGPIPE, SIGKILL}) {
      const TemporaryFolder folder;
      const pid_t child = ::fork();
      REQUIRE(child >= 0);
      if (child == 0) {
        ::signal(signal_number, SIG_DFL);  // a test runner may ignore it
        rgs::remove_temporaries_on_signal();
        auto file = AtomicFile::create(folder.file("out"), {});
        if (!file || !file->write_at(0, as_bytes("half"))) ::_exit(1);
        ::raise(signal_number);
        ::_exit(2);
      }
      int status = 0;
      REQUIRE(::waitpid(child, &status, 0) == child);
      CHECK(WIFSIGNALED(status));
      CHECK(WTERMSIG(status) == signal_number);
      CHECK(entries(folder.path()) == (!unnamed && signal_number == SIGKILL ? 1 : 0));
    }
  });
}

TEST_CASE("an output whose input changed its size does not appear") {
  const TemporaryFolder folder;
  const std::string in = folder.file("in"), out = folder.file("out");
  for (const std::uintmax_t size : {9U, 11U, 10U}) {  // less than a page is cut off: no signal, zeros
    CAPTURE(size);
    fs::remove(in);
    std::ofstream(in) << "0123456789";
    auto opened = MappedFile::open(in);
    REQUIRE(opened);
    const MappedFile mapped = std::move(*opened);  // moves take the descriptor along
    CHECK(opened->check_unchanged());
    auto file = AtomicFile::create(out, {.overwrite = true, .sync = false, .inputs = {&mapped}});
    REQUIRE(file);
    REQUIRE(file->write_at(0, mapped.bytes()));
    if (size != 10) fs::resize_file(in, size);
    const auto committed = file->commit();
    CHECK(committed.has_value() == (size == 10));
    CHECK(mapped.check_unchanged().has_value() == (size == 10));
    if (committed) continue;
    CHECK(committed.error().code == Errc::read_failed);
    CHECK(committed.error().offset == std::min<std::uintmax_t>(size, 10));
    CHECK(committed.error().expected == 10);
    CHECK(committed.error().found == size);
    *file = {};
    CHECK(entries(folder.path()) == 1);
  }
  CHECK(contents(out) == "0123456789");
}

TEST_CASE("a mapped file detects writes, and survives unlinking") {
  const TemporaryFolder folder;
  const std::string path = folder.file("in");
  const auto changed_by = [&](const auto& change) {
    fs::remove(path);
    std::ofstream(path) << "0123456789";
    rgs::test::wait_for_later_time(path);
    const auto file = MappedFile::open(path);
    REQUIRE(file);
    CHECK(file->check_unchanged());
    const auto time = fs::last_write_time(path);
    change(time);
    const auto status = file->check_unchanged();
    if (!status) CHECK(status.error().code == Errc::read_failed);
    return !status;
  };
  CHECK_FALSE(changed_by([](auto) {}));
  CHECK_FALSE(changed_by([&](auto) { fs::remove(path); }));
  CHECK_FALSE(changed_by([&](auto) { fs::create_hard_link(path, folder.file("other")); }));
  CHECK_FALSE(changed_by([&](auto) { contents(path); }));
  CHECK(changed_by([&](auto) { std::fstream(path, std::ios::in | std::ios::out) << "x"; }));
  CHECK(changed_by([&](auto time) {
    std::fstream(path, std::ios::in | std::ios::out) << "x";
    fs::last_write_time(path, time);
  }));
}

TEST_CASE("no output takes the descriptor of a standard stream") {
  for (const std::string name : {"out", "-"}) {
    const TemporaryFolder folder;
    const pid_t child = ::fork();
    REQUIRE(child >= 0);
    if (child == 0) {
      for (const int fd : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) ::close(fd);
      const auto file = AtomicFile::create(name == "-" ? name : folder.file(name), {});
      const bool good = file && file->descriptor() > STDERR_FILENO && ::fcntl(STDERR_FILENO, F_GETFD) < 0 &&
                        (::fcntl(file->descriptor(), F_GETFD) & FD_CLOEXEC) != 0;
      ::_exit(good ? 0 : 1);
    }
    int status = 0;
    REQUIRE(::waitpid(child, &status, 0) == child);
    CHECK(status == 0);
  }
}

TEST_CASE("links are followed to their targets") {
  const TemporaryFolder folder;
  const std::string target = folder.file("target"), one = folder.file("one"), two = folder.file("two");
  fs::create_symlink("target", one);
  fs::create_symlink(one, two);
  CHECK(rgs::follow_links(target) == target);
  CHECK(rgs::follow_links(one) == target);
  CHECK(rgs::follow_links(two) == target);  // which does not exist
  fs::create_symlink("loop", folder.file("loop"));
  CHECK(rgs::follow_links(folder.file("loop")) == folder.file("loop"));
}

TEST_CASE("an input truncated while mapped removes the output and exits with code 3, whoever reads it") {
  constexpr std::size_t kThreads = 4, kApart = 1 << 16;
  const TemporaryFolder folder;
  for (int turn = 0; turn < 50; ++turn) {
    std::ofstream(folder.file("in")) << std::string(kThreads * kApart, 'x');
    const pid_t child = ::fork();
    REQUIRE(child >= 0);
    if (child == 0) {
      ::close(STDERR_FILENO);
      rgs::remove_temporaries_on_signal();
      const auto in = MappedFile::open(folder.file("in"));
      const auto out = AtomicFile::create(folder.file("out"), {});
      if (!in || !out || ::truncate(folder.file("in").c_str(), 0) != 0) ::_exit(9);
      std::atomic<std::size_t> ready = 0;
      const auto read = [&](std::size_t part) {
        ++ready;
        while (ready != kThreads) std::this_thread::yield();
        ::_exit(in->bytes()[part * kApart] == std::byte{'x'} ? 8 : 7);
      };
      std::vector<std::thread> threads;
      for (std::size_t i = 1; i < kThreads; ++i) threads.emplace_back(read, i);
      read(0);
    }
    int status = 0;
    REQUIRE(::waitpid(child, &status, 0) == child);
    REQUIRE(WIFEXITED(status));
    REQUIRE(WEXITSTATUS(status) == 3);
    REQUIRE(entries(folder.path()) == 1);
  }
}
