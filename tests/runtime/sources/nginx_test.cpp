// nginx_test.cpp - files on a real web server: HTTP/2 over TLS, certificates, replaced files.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <array>
#include <cerrno>
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <future>
#include <limits>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "made_bytes.hpp"
#include "rgs/byte_source.hpp"
#include "skip.hpp"
#include "url_time.hpp"
#include "web_servers.hpp"

using namespace rgs;
using test::are_bytes_from;
using test::Nginx;
using test::write_bytes;

namespace {

constexpr std::uint64_t kSize = 3'000'000;

bool without_nginx() {
  if (Nginx::is_installed()) return false;
  test::skip_without_tool(std::string(Nginx::kProgram) + " is not installed");
  return true;
}

bool reads_right(ByteSource& source, std::uint64_t offset, std::size_t n) {
  std::vector<std::byte> bytes(n);
  const Status read = source.read(offset, bytes);
  if (!read) MESSAGE(errc_name(read.error().code), " ", read.error().what, " ", read.error().found);
  return read && are_bytes_from(offset, bytes);
}

// How many of 6 threads, with 20 reads each, read a wrong byte.
int wrong_readers(ByteSource& source) {
  std::array<int, 6> wrong{};
  std::vector<std::thread> threads;
  for (std::uint64_t t = 0; t < wrong.size(); ++t) {
    threads.emplace_back([&, t] {
      for (std::uint64_t i = 0; i < 20; ++i) {
        std::vector<std::byte> bytes(30001);
        const std::uint64_t offset = (t * 791937 + i * 104729) % (kSize - bytes.size());
        if (!source.read(offset, bytes) || !are_bytes_from(offset, bytes)) wrong[t] = 1;
      }
    });
  }
  int n = 0;
  for (std::size_t t = 0; t < wrong.size(); ++t) {
    threads[t].join();
    n += wrong[t];
  }
  return n;
}

}  // namespace

TEST_CASE("nginx: ranges") {
  if (without_nginx()) return;
  const Nginx nginx(false);
  write_bytes(nginx.file("scene.rgs"), kSize);
  const auto source = open_source(nginx.url("scene.rgs")).value();
  CHECK(source->size() == kSize);
  CHECK(reads_right(*source, 0, kSize));
  CHECK(wrong_readers(*source) == 0);
  std::set<std::string> connections;
  for (const std::string& line : nginx.log()) {
    CHECK(line.starts_with("HTTP/1.1 "));
    connections.insert(line.substr(9, line.find(' ', 9) - 9));
  }
  CHECK(connections.size() <= 6);
  const auto absent = open_source(nginx.url("absent.rgs"));
  CHECK(absent.error().code == Errc::open_failed);
  CHECK(absent.error().found == 404);
}

TEST_CASE("nginx: one connection of HTTP/2 over TLS, and an untrusted certificate is refused unless named") {
  if (without_nginx()) return;
  const Nginx nginx(true);
  write_bytes(nginx.file("scene.rgs"), kSize);
  UrlOptions options;
  options.certificates = nginx.certificate();
  const auto source = open_source(nginx.url("scene.rgs"), options).value();
  CHECK(reads_right(*source, 0, kSize));
  CHECK(wrong_readers(*source) == 0);
  const auto untrusted = open_source(nginx.url("scene.rgs"));
  REQUIRE_FALSE(untrusted);
  CHECK(untrusted.error().code == Errc::open_failed);
  CHECK(std::string(untrusted.error().what).find("certificate") != std::string::npos);
  // Trusted, but for another name.
  std::string other = nginx.url("scene.rgs");
  other.replace(other.find("127.0.0.1"), 9, "localhost");
  const auto misnamed = open_source(other, options);
  REQUIRE_FALSE(misnamed);
  CHECK(std::string(misnamed.error().what).find("certificate") != std::string::npos);
  options.certificates = nginx.file("scene.rgs");  // holds none
  CHECK(open_source(nginx.url("scene.rgs"), options).error().code == Errc::open_failed);
  std::set<std::string> connections;
  for (const std::string& line : nginx.log()) {
    CHECK(line.starts_with("HTTP/2.0 "));
    connections.insert(line.substr(9, line.find(' ', 9) - 9));
  }
  CHECK(connections.size() == 1);
}

TEST_CASE("nginx: never from https to http") {
  if (without_nginx()) return;
  const Nginx plain(false);
  write_bytes(plain.file("scene.rgs"), kSize);
  const Nginx safe(
      true, "location /away { return 302 " + plain.url("scene.rgs") + "; } location /here { return 302 /scene.rgs; }");
  write_bytes(safe.file("scene.rgs"), kSize);
  UrlOptions options;
  options.certificates = safe.certificate();
  const auto refused = open_source(safe.url("away"), options);
  REQUIRE_FALSE(refused);
  CHECK(std::string(refused.error().what).find("from https to http") != std::string::npos);
  CHECK(plain.log().empty());
  CHECK(reads_right(*open_source(safe.url("here"), options).value(), 5, 1'000'000));
}

TEST_CASE("nginx: a replaced or removed file is an error") {
  if (without_nginx()) return;
  const Nginx nginx(false);
  std::vector<std::byte> bytes(1000);
  write_bytes(nginx.file("scene.rgs"), kSize);
  auto source = open_source(nginx.url("scene.rgs")).value();
  CHECK(reads_right(*source, 1'000'000, 1000));
  // Of the same size; nginx's tag has the second of the write.
  write_bytes(nginx.file("new"), kSize);
  std::filesystem::last_write_time(nginx.file("new"),
                                   std::filesystem::last_write_time(nginx.file("new")) + std::chrono::seconds(5));
  std::filesystem::rename(nginx.file("new"), nginx.file("scene.rgs"));
  Status read = source->read(1'000'000, bytes);
  REQUIRE_FALSE(read);
  CHECK(read.error().code == Errc::read_failed);
  CHECK(std::string(read.error().what).find("has changed") != std::string::npos);

  source = open_source(nginx.url("scene.rgs")).value();
  std::filesystem::resize_file(nginx.file("scene.rgs"), 500'000);
  CHECK(source->read(1'000'000, bytes).error().expected == kSize);
  std::filesystem::remove(nginx.file("scene.rgs"));
  CHECK(source->read(1'000'000, bytes).error().found == 404);
}

namespace {

/// Connections to a port with received bytes that its program has not read.
int n_unread(int port) {
  std::ifstream table("/proc/net/tcp");
  int n = 0;
  std::string number, local, remote, state, queues;
  for (std::string line; std::getline(table, line);) {
    std::istringstream(line) >> number >> local >> remote >> state >> queues;
    const std::size_t colon = local.find(':');
    if (colon == local.npos || std::stoi(local.substr(colon + 1), nullptr, 16) != port || state == "0A") continue;
    n += queues.substr(queues.find(':') + 1) != "00000000";
  }
  return n;
}

}  // namespace

TEST_CASE("nginx: a server that freezes, restarts, or is gone") {
  if (without_nginx()) return;
  for (const bool ssl : {false, true}) {
    CAPTURE(ssl);
    Nginx nginx(ssl);
    write_bytes(nginx.file("scene.rgs"), kSize);
    UrlOptions options;
    options.stall_seconds = options.connect_seconds = 86400;
    options.retries = std::numeric_limits<int>::max();
    if (ssl) options.certificates = nginx.certificate();
    {
      test::UrlTime time;
      const auto frozen = detail::open_url_source(nginx.url("scene.rgs"), options, time.clock()).value();
      nginx.freeze();
      auto reading = std::async(std::launch::async, [&] { return reads_right(*frozen, 1'000'000, 500'000); });
      test::await([&] { return n_unread(nginx.port()) == 1; });
      time.advance(0);
      time.advance(86400);
      time.advance(0.25);
      test::await([&] { return n_unread(nginx.port()) == 2; });  // again, over another connection
      nginx.resume();
      CHECK(reading.get());
    }
    const auto source = open_source(nginx.url("scene.rgs"), options).value();
    nginx.end();
    nginx.start_again();
    CHECK(reads_right(*source, 1'000'000, 500'000));

    nginx.end();
    auto wrong = std::async(std::launch::async, [&] { return wrong_readers(*source); });
    nginx.start_again();
    CHECK(wrong.get() == 0);

    options.retries = 1;
    const auto impatient = open_source(nginx.url("scene.rgs"), options).value();
    nginx.end();
    std::vector<std::byte> bytes(1000);
    const Status read = impatient->read(1'000'000, bytes);
    REQUIRE_FALSE(read);
    CHECK(read.error().code == Errc::read_failed);
    CHECK(read.error().offset == 1'000'000);
    CHECK(read.error().system == ECONNREFUSED);
  }
}
