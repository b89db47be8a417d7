// file_source_test.cpp - files read by ranges: right bytes, ends, changing files, cancelling.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <filesystem>
#include <fstream>
#include <thread>
#include <vector>

#include "file_times.hpp"
#include "made_bytes.hpp"
#include "rgs/byte_source.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using test::are_bytes_from;
using test::write_bytes;

TEST_CASE("a file is read by ranges, and not beyond its end") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("scene.rgs");
  constexpr std::uint64_t kSize = 9'000'001;  // more than one part
  write_bytes(path, kSize);
  const auto source = open_source(path).value();
  CHECK(source->size() == kSize);
  for (const auto& range : {std::pair<std::uint64_t, std::uint64_t>{0, kSize},
                            {0, 1},
                            {1234567, 100000},
                            {kSize - 1, 1},
                            {kSize, 0},
                            {5, 0}}) {
    const auto [offset, n] = range;
    CAPTURE(range.first);
    std::vector<std::byte> bytes(n);
    REQUIRE(source->read(offset, bytes));
    CHECK(are_bytes_from(offset, bytes));
  }
  for (const auto& range :
       {std::pair<std::uint64_t, std::uint64_t>{kSize, 1}, {kSize - 1, 2}, {~std::uint64_t{0}, 2}, {kSize + 1, 0}}) {
    const auto [offset, n] = range;
    CAPTURE(range.first);
    std::vector<std::byte> bytes(n);
    const Status read = source->read(offset, bytes);
    REQUIRE_FALSE(read);
    CHECK(read.error().code == Errc::read_failed);
    CHECK(read.error().offset == offset);
  }
}

TEST_CASE("several threads read one file") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("scene.rgs");
  constexpr std::uint64_t kSize = 1 << 20;
  write_bytes(path, kSize);
  const auto source = open_file_source(path).value();
  std::array<int, 4> wrong{};
  std::vector<std::thread> threads;
  for (std::uint64_t t = 0; t < wrong.size(); ++t) {
    threads.emplace_back([&, t] {
      for (std::uint64_t i = 0; i < 200; ++i) {
        std::vector<std::byte> bytes(3001);
        const std::uint64_t offset = (t * 7919 + i * 104729) % (kSize - bytes.size());
        if (!source->read(offset, bytes) || !are_bytes_from(offset, bytes)) ++wrong[t];
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  CHECK(wrong == std::array<int, 4>{});
}

TEST_CASE("a path that is no regular file is refused") {
  const test::TemporaryFolder folder;
  const std::string fifo = folder.file("fifo");
  REQUIRE(::mkfifo(fifo.c_str(), 0600) == 0);
  for (const std::string& path : {folder.file("absent"), folder.path().string(), fifo, std::string()}) {
    CAPTURE(path);
    const auto source = open_source(path);
    REQUIRE_FALSE(source);
    CHECK(source.error().code == Errc::open_failed);
  }
  CHECK(open_file_source(folder.file("absent")).error().system == ENOENT);
}

TEST_CASE("a file that shrinks, grows or is written to fails the next read; a renamed one does not") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("scene.rgs");
  std::vector<std::byte> bytes(1000);
  const auto read_after = [&](const auto& change) {
    write_bytes(path, 100000);
    const auto source = open_file_source(path).value();
    REQUIRE(source->read(50000, bytes));
    test::wait_for_later_time(path);
    change();
    return source->read(50000, bytes);
  };
  const auto shrink = [&](std::uintmax_t size) { return [&, size] { std::filesystem::resize_file(path, size); }; };
  const auto overwrite = [&] { std::fstream(path, std::ios::binary | std::ios::in | std::ios::out).seekp(7).put('x'); };
  CHECK(read_after(shrink(50500)).error().code == Errc::read_failed);
  CHECK(read_after(shrink(50500)).error().offset == 50500);
  CHECK(read_after(shrink(0)).error().code == Errc::read_failed);
  CHECK(read_after(shrink(99999)).error().code == Errc::read_failed);  // beyond the read range
  CHECK(read_after(shrink(100001)).error().code == Errc::read_failed);
  CHECK(read_after(overwrite).error().code == Errc::read_failed);
  CHECK(read_after([&] {
          const auto time = std::filesystem::last_write_time(path);
          overwrite();
          std::filesystem::last_write_time(path, time);
        })
            .error()
            .code == Errc::read_failed);
  // The old file exists until it is closed.
  CHECK(read_after([&] { std::filesystem::remove(path); }));
  CHECK(are_bytes_from(50000, bytes));
  CHECK(read_after([&] {
    write_bytes(folder.file("new"), 5);
    std::filesystem::rename(folder.file("new"), path);
  }));
  CHECK(are_bytes_from(50000, bytes));
}

TEST_CASE("a cancelled source reads nothing more") {
  const test::TemporaryFolder folder;
  const std::string path = folder.file("scene.rgs");
  write_bytes(path, 1000);
  const auto source = open_file_source(path).value();
  std::vector<std::byte> bytes(10);
  REQUIRE(source->read(0, bytes));
  source->cancel();
  CHECK(source->read(0, bytes).error().code == Errc::cancelled);
  CHECK(source->read(0, {}).error().code == Errc::cancelled);
  CHECK(source->size() == 1000);
}

TEST_CASE("addresses and paths are distinguished") {
  for (const char* name : {"http://a", "https://a/b.rgs", "HTTPS://A", "Http://x"}) CHECK(is_url(name));
  for (const char* name :
       {"", "h", "http", "http:", "http:/a", "https:/", "ftp://a", "file:///a", "./http://a", "ahttp://a", " http://a"})
    CHECK_FALSE(is_url(name));
}
