// faults_test.cpp - rgs-convert with full disks, missing permissions, vanishing inputs and signals. Whatever happens,
// the output's name holds the old file or the complete new one.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/mount.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "convert_scenes.hpp"
#include "edit_file.hpp"
#include "file_times.hpp"
#include "rgs/interchange.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

constexpr std::uint64_t kN = 20'000;
constexpr const char* kOld = "the output of an earlier run";

/// A scene and its conversion, made once; tests hard-link or copy the files into their folders.
struct Sample {
  explicit Sample(std::uint64_t n) : ply(folder.file("scene.ply")), rgs(folder.file("scene.rgs")) {
    write_scene(ply, golden_cloud(n, 3, 77));
    REQUIRE(run_program({built("rgs-convert"), "--quiet", "--no-sync", ply, rgs}).exit_code == 0);
  }
  TemporaryFolder folder;
  std::string ply, rgs;
};

const Sample& sample() {
  static const Sample made(kN);
  return made;
}

bool same_contents(const std::string& a, const std::string& b) {
  const auto x = MappedFile::open(a), y = MappedFile::open(b);
  return x && y && std::ranges::equal(x->bytes(), y->bytes());
}

bool is_old(const std::string& path) {
  const auto file = MappedFile::open(path);
  return file && std::ranges::equal(file->bytes(), std::as_bytes(std::span(kOld, std::strlen(kOld))));
}

std::vector<std::string> temporaries(const fs::path& folder) {
  std::vector<std::string> paths;
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (entry.path().filename().string().find(".tmp-") != std::string::npos) paths.push_back(entry.path().string());
  }
  return paths;
}

std::vector<std::string> overwriting(const std::string& input, const std::string& output) {
  return {built("rgs-convert"), "--quiet", "--no-sync", "--overwrite", input, output};
}

ProgramResult overwrite(const std::string& input, const std::string& output,
                        const std::function<void()>& before_exec = {}) {
  return run_program(overwriting(input, output), before_exec);
}

/// The start of a stage that reads `source`.
struct Reading {
  std::string source;
  const char *output, *stage;
};
const std::vector<Reading>& readings() {
  static const TemporaryFolder folder;
  // A packed file may have read all rows before it writes the first; a direct one has not.
  static const std::string direct = folder.file("direct.rgs");
  static const ProgramResult made =
      run_program({built("rgs-convert"), "--quiet", "--no-sync", "--profile", "direct", sample().ply, direct});
  REQUIRE(made.exit_code == 0);
  static const std::vector<Reading> all{
      {sample().ply, "out.rgs", "scan"}, {sample().ply, "out.rgs", "encode"}, {direct, "out.ply", "decode"}};
  return all;
}

}  // namespace

TEST_CASE("headers that declare billions of Gaussians are refused in little memory") {
  const TemporaryFolder folder;
  const SplatCloud cloud = golden_cloud(50, 1, 3);
  struct Case {
    SplatFormat format;
    std::size_t offset;  // of a 32-bit count
  };
  for (const Case c : {Case{SplatFormat::spz, 8}, Case{SplatFormat::glb, 8}}) {
    CAPTURE(format_name(c.format));
    Bytes bytes = encode_splats(cloud.view(), c.format).value();
    put(bytes, c.offset, 0xFFFFFFF0U);
    const std::string path = folder.file("scene.bin");
    write_text(path, {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
    const ProgramResult run = run_program({built("rgs-convert"), "--no-sync", path, folder.file("out.rgs")}, [] {
      const rlimit limit{rlim_t{1} << 29, rlim_t{1} << 29};
      if (!kSanitized) ::setrlimit(RLIMIT_AS, &limit);  // sanitizers reserve terabytes of addresses
    });
    CAPTURE(run.err);
    CHECK(run.exit_code == 4);
    CHECK(run.err.find("byte ") != std::string::npos);
  }
}

TEST_CASE("a full disk leaves the old output and no temporary file") {
  const TemporaryFolder folder;
  const fs::path disk = folder.path() / "disk";
  fs::create_directory(disk);
  // Without one, another case uses a limit of file sizes.
  if (::mount("tmpfs", disk.c_str(), "tmpfs", 0, "size=1m") != 0)
    return skip("a small file system cannot be mounted here (needs root)");
  struct Unmount {
    const fs::path& disk;
    ~Unmount() { ::umount2(disk.c_str(), MNT_DETACH); }
  } const unmount{disk};
  for (const auto& pair : {std::pair{sample().ply, "out.rgs"}, std::pair{sample().rgs, "out.ply"}}) {
    const auto& input = pair.first;
    const char* const name = pair.second;
    CAPTURE(name);
    const std::string out = (disk / name).string();
    ProgramResult run = overwrite(input, out);
    CHECK(run.exit_code == 3);
    CHECK(run.err.find("No space left on device") != std::string::npos);
    CHECK(fs::is_empty(disk));
    write_text(out, kOld);
    CHECK(overwrite(input, out).exit_code == 3);
    CHECK(is_old(out));
    CHECK(entries(disk) == 1);
    fs::remove(out);
  }
}

TEST_CASE("a limit of file sizes is a reported error, not death by signal") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out.rgs");
  write_text(out, kOld);
  const ProgramResult run = overwrite(sample().ply, out, [] {
    const rlimit limit{1 << 20, 1 << 20};
    ::setrlimit(RLIMIT_FSIZE, &limit);
  });
  CHECK(run.exit_code == 3);
  CHECK(run.err.find("File too large") != std::string::npos);
  CHECK(is_old(out));
  CHECK(entries(folder.path()) == 1);
}

TEST_CASE("a full scratch disk fails the pipe and writes nothing") {
  const ProgramResult run = run_program({built("rgs-convert"), "--quiet", "--to", "rgs", sample().ply, "-"}, [] {
    const rlimit limit{1 << 20, 1 << 20};
    ::setrlimit(RLIMIT_FSIZE, &limit);
  });
  CHECK(run.exit_code == 3);
  CHECK(run.out == "");
}

TEST_CASE("a folder without write permission is reported and unchanged") {
  const TemporaryFolder folder;
  const fs::path locked = folder.path() / "locked";
  const std::string program = folder.file("rgs-convert"), input = folder.file("scene.ply"),
                    out = (locked / "out.rgs").string();
  fs::create_directory(locked);
  write_text(out, kOld);
  fs::copy_file(built("rgs-convert"), program);  // a path that the other user can reach
  fs::copy_file(sample().ply, input);
  fs::permissions(locked, fs::perms(0555));
  fs::permissions(folder.path(), fs::perms(0755));
  const bool root = ::geteuid() == 0;
  const ProgramResult run = run_program({program, "--quiet", "--no-sync", "--overwrite", input, out}, [root] {
    constexpr unsigned kNobody = 65534;
    if (root && (::setgid(kNobody) != 0 || ::setuid(kNobody) != 0)) ::_exit(126);
  });
  fs::permissions(locked, fs::perms(0755));
  if (run.exit_code == 126) return skip("root cannot become another user here");
  CHECK(is_old(out));
  CHECK(entries(locked) == 1);
  CHECK(run.exit_code == 3);
  CHECK(run.err.find("Permission denied") != std::string::npos);
}

TEST_CASE("an output that is the input, a folder, or in a missing folder is refused") {
  const TemporaryFolder folder;
  const std::string ply = folder.file("scene.ply"), link = folder.file("link.rgs");
  fs::copy_file(sample().ply, ply);
  fs::create_hard_link(ply, link);
  for (const std::string& out : {ply, link, folder.path().string(), folder.file("missing/out.rgs")}) {
    CAPTURE(out);
    const ProgramResult run = run_program({built("rgs-convert"), "--no-sync", "--overwrite", "--to", "rgs", ply, out});
    CHECK(run.exit_code == (out == ply || out == link ? 2 : 3));
    CHECK(run.out == "");
    CHECK(run.err != "");
  }
  CHECK(same_contents(ply, sample().ply));
  CHECK(entries(folder.path()) == 2);
}

TEST_CASE("an existing output stays unless --overwrite is given") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out.rgs");
  write_text(out, kOld);
  const ProgramResult run = run_program({built("rgs-convert"), "--no-sync", sample().ply, out});
  CHECK(run.exit_code == 3);
  CHECK(run.err.find("--overwrite") != std::string::npos);
  CHECK(is_old(out));
  CHECK(overwrite(sample().ply, out).exit_code == 0);
  CHECK(same_contents(out, sample().rgs));
}

TEST_CASE("a missing input exits with 3, a folder without --to with 2") {
  const TemporaryFolder folder;
  CHECK(overwrite(folder.file("none.ply"), folder.file("out.rgs")).exit_code == 3);
  CHECK(overwrite(folder.path().string(), folder.file("out.rgs")).exit_code == 2);
  CHECK(fs::is_empty(folder.path()));
}

TEST_CASE("an input that is unlinked while it is read is converted to the end") {
  const TemporaryFolder folder;
  const std::string ply = folder.file("scene.ply"), out = folder.file("out.rgs");
  fs::copy_file(sample().ply, ply);
  Program program(overwriting(ply, out), failpoint("scan"));
  REQUIRE(program.stops());
  fs::remove(ply);
  program.send(SIGCONT);
  CHECK(program.wait().exit_code == 0);
  CHECK(same_contents(out, sample().rgs));
}

TEST_CASE("an input that is truncated while it is read exits with 3 and keeps the old output") {
  const TemporaryFolder folder;
  const std::string input = folder.file("input");
  for (const Reading& reading : readings()) {
    const auto error_of = [&](std::uintmax_t size) {
      const std::string out = folder.file(reading.output);
      fs::copy_file(reading.source, input, fs::copy_options::overwrite_existing);
      write_text(out, kOld);
      Program program(overwriting(input, out), failpoint(reading.stage));
      REQUIRE(program.stops());
      fs::resize_file(input, size);
      program.send(SIGCONT);
      const ProgramResult run = program.wait();
      CHECK(run.exit_code == 3);
      CHECK(is_old(out));
      CHECK(temporaries(folder.path()).empty());
      return run.err;
    };
    CAPTURE(std::string(reading.stage));
    CHECK(error_of(4096) ==
          "rgs-convert: " + input + ": shrank or became unreadable while it was being read [read_failed]\n");
    // Less than a page raises no signal: the missing part reads as zeros.
    const std::string error = error_of(fs::file_size(reading.source) - 1);
    CHECK(error.find("input: byte ") != std::string::npos);
    CHECK(error.find("size changed") != std::string::npos);
  }
}

TEST_CASE("an input that is rewritten in place while it is read exits with 3 and keeps the old output") {
  const TemporaryFolder folder;
  const std::string input = folder.file("input");
  // Like another program's write: the same size, other values from some byte on. With a mapping, a file system may
  // report the change late, and resetting the time hides it from a check of that time alone.
  enum class How { write, map, write_and_set_time };
  const auto rewrite = [&](How how, double from) {
    const std::uintmax_t size = fs::file_size(input);
    const auto first = static_cast<std::size_t>(from * static_cast<double>(size));
    const fs::file_time_type time = fs::last_write_time(input);
    const int fd = ::open(input.c_str(), O_RDWR | O_CLOEXEC);
    REQUIRE(fd >= 0);
    const std::string junk(size - first, '\x41');
    if (how == How::map) {
      void* const data = ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
      REQUIRE(data != MAP_FAILED);
      std::memcpy(static_cast<char*>(data) + first, junk.data(), junk.size());
      ::munmap(data, size);
    } else {
      REQUIRE(::pwrite(fd, junk.data(), junk.size(), static_cast<off_t>(first)) == static_cast<ssize_t>(junk.size()));
    }
    ::close(fd);
    if (how == How::write_and_set_time) fs::last_write_time(input, time);
  };
  for (const Reading& reading : readings()) {
    for (const How how : {How::write, How::map, How::write_and_set_time}) {
      for (const double from : {0.05, 0.3, 0.6, 0.9}) {
        CAPTURE(std::string(reading.stage));
        CAPTURE(static_cast<int>(how));
        CAPTURE(from);
        const std::string out = folder.file(reading.output);
        fs::copy_file(reading.source, input, fs::copy_options::overwrite_existing);
        write_text(out, kOld);
        Program program(overwriting(input, out), failpoint(reading.stage));
        REQUIRE(program.stops());
        wait_for_later_time(input);
        rewrite(how, from);
        program.send(SIGCONT);
        const ProgramResult run = program.wait();
        CAPTURE(run.err);
        CHECK(run.exit_code == 3);
        CHECK(run.err.find("changed while it was read") != std::string::npos);
        CHECK(is_old(out));
        CHECK(temporaries(folder.path()).empty());
      }
    }
  }
}

TEST_CASE("--overwrite keeps permissions and owner, and follows a link to its target") {
  const TemporaryFolder folder;
  const fs::path real = folder.path() / "real";
  fs::create_directory(real);
  const std::string target = (real / "scene.rgs").string(), link = folder.file("link.rgs"),
                    chain = folder.file("chain.rgs"), dangling = folder.file("dangling.rgs");
  fs::create_symlink("real/scene.rgs", link);
  fs::create_symlink("link.rgs", chain);
  fs::create_symlink("real/new.rgs", dangling);
  for (const std::string& out : {target, link, chain}) {
    for (const mode_t mode : {0600U, 0640U, 0444U, 0666U}) {
      CAPTURE(out);
      CAPTURE(mode);
      fs::remove(target);
      write_text(target, kOld);
      REQUIRE(::chmod(target.c_str(), mode) == 0);
      constexpr uid_t kSomebody = 12345;
      const bool root = ::geteuid() == 0;
      if (root) REQUIRE(::chown(target.c_str(), kSomebody, kSomebody + 1) == 0);
      CHECK(overwrite(sample().ply, out).exit_code == 0);
      CHECK(same_contents(target, sample().rgs));
      struct stat info {};
      REQUIRE(::stat(target.c_str(), &info) == 0);
      CHECK((info.st_mode & 07777) == mode);
      if (root) CHECK(info.st_uid == kSomebody);
      if (root) CHECK(info.st_gid == kSomebody + 1);
      CHECK(fs::is_symlink(link));
      CHECK(fs::is_symlink(chain));
      CHECK(entries(real) == 1);
    }
  }
  // Without --overwrite nothing behind a link changes, and a dangling link's target is created.
  CHECK(run_program({built("rgs-convert"), "--no-sync", sample().ply, chain}).exit_code == 3);
  CHECK(run_program({built("rgs-convert"), "--quiet", "--no-sync", sample().ply, dangling}).exit_code == 0);
  CHECK(fs::is_symlink(dangling));
  CHECK(same_contents((real / "new.rgs").string(), sample().rgs));
  const std::string loop = folder.file("loop.rgs");
  fs::create_symlink("loop.rgs", loop);
  CHECK(overwrite(sample().ply, loop).exit_code == 3);
  CHECK(fs::is_symlink(loop));
}

TEST_CASE("a signal that the caller ignores stays ignored") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out.rgs");
  Program program(overwriting(sample().ply, out), [] {
    ::signal(SIGHUP, SIG_IGN);
    failpoint("scan", 0, SIGHUP)();
  });
  CHECK(program.wait().exit_code == 0);
  CHECK(same_contents(out, sample().rgs));
}

TEST_CASE("a pipe that closes during progress ends the program by SIGPIPE and leaves nothing") {
  const TemporaryFolder folder;
  int ends[2];
  REQUIRE(::pipe2(ends, O_CLOEXEC) == 0);
  Program program({built("rgs-convert"), "--no-sync", sample().ply, folder.file("out.rgs")}, [&] {
    ::dup2(ends[1], STDERR_FILENO);
    failpoint("scan")();
  });
  REQUIRE(program.stops());
  ::close(ends[0]);
  ::close(ends[1]);
  program.send(SIGCONT);
  CHECK(program.wait().signal == SIGPIPE);
  CHECK(fs::is_empty(folder.path()));
}

TEST_CASE("SIGINT and SIGKILL leave the old output or none, whenever they arrive") {
  const TemporaryFolder folder;
  const std::string out = folder.file("out.rgs");
  std::vector<std::pair<const char*, std::uint64_t>> points{{"scan", 0}, {"sort", 0}, {"commit", 0}};
  for (const char* stage : {"scan", "encode"}) {
    for (std::uint64_t units = 1; units <= kN; units += kN / 4) points.emplace_back(stage, units);
    points.emplace_back(stage, kN);
  }
  for (const int signal_number : {SIGINT, SIGKILL}) {
    for (const auto& point : points) {
      const char* const stage = point.first;  // clang 14 captures no structured bindings
      const std::uint64_t units = point.second;
      for (const bool had_old : {true, false}) {
        CAPTURE(signal_number);
        CAPTURE(std::string(stage));
        CAPTURE(units);
        CAPTURE(had_old);
        fs::remove(out);
        if (had_old) write_text(out, kOld);
        CHECK(overwrite(sample().ply, out, failpoint(stage, units, signal_number)).signal == signal_number);
        CHECK((had_old ? is_old(out) : !fs::exists(out)));
        CHECK(entries(folder.path()) == (had_old ? 1U : 0U));
      }
    }
  }
  CHECK(overwrite(sample().ply, out).exit_code == 0);
  CHECK(same_contents(out, sample().rgs));
}

TEST_CASE("SIGKILL while levels are built leaves the old output, and nothing in the scratch folder") {
  const TemporaryFolder source, folder, scratch;
  const std::string ply = write_scene(source.file("scene.ply"), golden_cloud(160'000, 3, 78)),  // 38 MB of rows
      out = folder.file("out.rgs");
  write_text(out, kOld);
  for (const std::string stage : {"cut", "place", "levels", "encode"}) {
    CAPTURE(stage);
    Program program({built("rgs-convert"), "--quiet", "--no-sync", "--overwrite", "--lod", "--memory", "128MiB",
                     "--scratch", scratch.path().string(), ply, out},
                    failpoint(stage));
    REQUIRE(program.stops());
    std::size_t n_open = 0;  // unlinked scratch files
    for (const auto& fd : fs::directory_iterator("/proc/" + std::to_string(program.id()) + "/fd"))
      n_open += fs::read_symlink(fd).string().starts_with(fs::canonical(scratch.path()).string()) ? 1U : 0U;
    CHECK(n_open > 0);
    CHECK(fs::is_empty(scratch.path()));
    program.send(SIGKILL);
    CHECK(program.wait().signal == SIGKILL);
    CHECK(is_old(out));
    CHECK(fs::is_empty(scratch.path()));
    CHECK(entries(folder.path()) == 1);
  }
}
