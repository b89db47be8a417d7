// url_source_test.cpp - files on web servers that misbehave in every way: the right bytes or the right error.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <future>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>
#include <stop_token>
#include <string_view>
#include <thread>
#include <vector>

#include "checkout.hpp"
#include "made_bytes.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/version.hpp"
#include "sources/http_answer.hpp"
#include "sources/url_clock.hpp"
#include "url_time.hpp"
#include "web_servers.hpp"

using namespace rgs;
using test::are_bytes_from;
using test::HostileServer;
using test::Peer;
using test::UrlTime;

namespace {

constexpr std::uint64_t kSize = 300000;      // of the server's files
constexpr std::uint64_t kBeginning = 65536;  // the range that opening requests
constexpr std::uint64_t kFrom = 100000;      // of the reads below
constexpr std::size_t kBytes = 100000;

// No time limit applies, however slow the machine.
UrlOptions patient() {
  UrlOptions options;
  options.retries = 1;
  options.open_seconds = options.connect_seconds = options.stall_seconds = 86400;
  return options;
}
UrlOptions untiring() {
  UrlOptions options = patient();
  options.retries = std::numeric_limits<int>::max();
  return options;
}

bool reads_right(ByteSource& source, std::uint64_t offset, std::size_t n) {
  std::vector<std::byte> bytes(n);
  const Status read = source.read(offset, bytes);
  if (!read) MESSAGE(errc_name(read.error().code), " ", read.error().what, " ", read.error().found);
  return read && are_bytes_from(offset, bytes);
}

// Opens, then reads: the first error; none if the bytes are right.
struct Outcome {
  bool opened = false;
  Status status;
  std::string what() const { return status ? "" : status.error().what; }
};

Outcome read_from(const std::string& url, const UrlOptions& options = patient(), const detail::UrlClock& clock = {}) {
  Outcome outcome;
  const auto source = detail::open_url_source(url, options, clock);
  if (!source) {
    outcome.status = tl::unexpected(source.error());
    return outcome;
  }
  outcome.opened = true;
  CHECK((*source)->size() == kSize);
  std::vector<std::byte> bytes(kBytes);
  outcome.status = (*source)->read(kFrom, bytes);
  if (outcome.status) CHECK(are_bytes_from(kFrom, bytes));
  return outcome;
}

bool has(const std::string& text, std::string_view part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_CASE("Content-Range is read strictly") {
  const auto r = detail::parse_content_range("bytes 5-9/100");
  REQUIRE(r);
  CHECK(r->satisfied);
  CHECK(r->first == 5);
  CHECK(r->last == 9);
  CHECK(r->total == 100);
  CHECK(detail::parse_content_range(" Bytes  0-0/1 \r\n"));
  CHECK_FALSE(detail::parse_content_range("bytes 0-0/*")->total);
  CHECK_FALSE(detail::parse_content_range("bytes */7")->satisfied);
  CHECK(detail::parse_content_range("bytes 0-18446744073709551614/18446744073709551615"));
  for (const char* text :
       {"", "bytes", "bytes ", "bytes 5-9", "bytes 5-4/100", "bytes 5-100/100", "bytes -9/100", "bytes 5-/100",
        "bytes 5-9/", "bytes 5-9/100x", "bytes +5-9/100", "bytes 5 - 9/100", "items 5-9/100", "bytes 5-9/-1",
        "bytes 0-18446744073709551615/18446744073709551616", "bytes 0x1-9/100", "bytes=5-9/100"}) {
    CAPTURE(std::string(text));
    CHECK_FALSE(detail::parse_content_range(text));
  }
}

TEST_CASE("a file on a server is read by ranges, and its first bytes only once") {
  const HostileServer server;
  const auto source = open_source(server.url("/plain"), patient()).value();
  CHECK(source->size() == kSize);
  CHECK(server.requests() == 1);
  CHECK(reads_right(*source, 0, kBeginning));
  CHECK(reads_right(*source, 100, 1));
  CHECK(reads_right(*source, kSize, 0));
  CHECK(server.requests() == 1);
  CHECK(reads_right(*source, kBeginning - 10, 20));
  CHECK(server.requests("range=bytes=65536-65545 ") == 1);
  CHECK(reads_right(*source, 0, kSize));
  CHECK(server.requests("range=bytes=65536-299999 ") == 1);
  CHECK(reads_right(*source, kSize - 1, 1));
  CHECK(server.requests() == 4);
  for (const auto& [offset, n] :
       {std::pair<std::uint64_t, std::uint64_t>{kSize, 1}, {kSize - 1, 2}, {~std::uint64_t{0}, 2}, {0, kSize + 1}}) {
    std::vector<std::byte> bytes(n);
    const Status read = source->read(offset, bytes);
    REQUIRE_FALSE(read);
    CHECK(read.error().code == Errc::read_failed);
    CHECK(read.error().offset == offset);
  }
  CHECK(server.requests() == 4);
  // What the server learns about us.
  CHECK(server.requests(" auth= agent=roofgs/" RGS_VERSION " encoding=identity cookie= if-range=") == 4);
}

TEST_CASE("small and empty files") {
  const HostileServer server;
  for (const std::uint64_t size : {std::uint64_t{1}, kBeginning - 1, kBeginning, kBeginning + 1}) {
    CAPTURE(size);
    const auto source = open_url_source(server.url("/plain?size=" + std::to_string(size)), patient());
    REQUIRE(source);
    CHECK((*source)->size() == size);
    CHECK(reads_right(**source, 0, size));
  }
  // 416, or the whole file.
  const auto empty = open_url_source(server.url("/status?code=416&range=bytes+*/0"), patient());
  REQUIRE(empty);
  CHECK((*empty)->size() == 0);
  CHECK(open_url_source(server.url("/no-ranges?size=0"), patient()).value()->size() == 0);
}

TEST_CASE("many threads read one file with a few requests in flight") {
  const HostileServer server;
  UrlOptions options = patient();
  options.reads_at_once = 3;
  const auto source = open_url_source(server.url("/busy?from=2&n=3"), options).value();
  CHECK(source->traits().reads_at_once == 3);
  std::array<int, 8> wrong{};
  std::vector<std::thread> threads;
  for (std::uint64_t t = 0; t < wrong.size(); ++t) {
    threads.emplace_back([&, t] {
      for (std::uint64_t i = 0; i < 3; ++i) {
        std::vector<std::byte> bytes(3001);
        const std::uint64_t offset = kBeginning + (t * 7919 + i * 104729) % (kSize - kBeginning - bytes.size());
        if (!source->read(offset, bytes) || !are_bytes_from(offset, bytes)) ++wrong[t];
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  CHECK(wrong == std::array<int, 8>{});
  CHECK(has(server.log(), "at work 3\n"));
  CHECK_FALSE(has(server.log(), "at work 4\n"));
}

TEST_CASE("a server without ranges is an error unless the file is small") {
  const HostileServer server;
  for (const char* path : {"/no-ranges", "/no-ranges-chunked", "/no-ranges-unknown-length",
                           "/no-ranges-chunked?size=1000", "/no-ranges-unknown-length?size=1000"}) {
    CAPTURE(std::string(path));
    const auto source = open_url_source(server.url(path), patient());
    REQUIRE_FALSE(source);
    CHECK(source.error().code == Errc::open_failed);
    CHECK(source.error().found == 200);
    CHECK(has(source.error().what, "range requests"));
  }
  const auto small = open_url_source(server.url("/no-ranges?size=1000"), patient());
  REQUIRE(small);
  CHECK(reads_right(**small, 0, 1000));
  // It breaks off and restarts from the first byte, a limited number of times.
  const auto broken = open_url_source(server.url("/no-ranges-broken?size=1000&breaks=1&etag=a"), patient());
  REQUIRE(broken);
  CHECK(reads_right(**broken, 0, 1000));
  CHECK_FALSE(open_url_source(server.url("/no-ranges-broken?size=1000&breaks=1000"), patient()));
  CHECK(server.requests("/no-ranges-broken?size=1000&breaks=1000 ") == 2);
  // Another file, of another length, does not continue it.
  CHECK_FALSE(open_url_source(server.url("/no-ranges-broken?size=1000&grows=1&breaks=1"), patient()));
  // Ranges that end in the middle.
  const Outcome later = read_from(server.url("/no-ranges?from=2"));
  CHECK(later.opened);
  REQUIRE_FALSE(later.status);
  CHECK(later.status.error().found == 200);
  CHECK(server.requests("/no-ranges?from=2 ") == 2);
}

TEST_CASE("a file on a server is read by the rules that both readers have") {
  std::ifstream file(test::source_dir() + "/tests/golden/http-rules.json");
  const auto rules = nlohmann::json::parse(file);
  const HostileServer server;
  UrlOptions options = patient();
  options.retries = rules["retries"];
  UrlTime time(std::chrono::milliseconds(250));
  int n = 0;
  for (const auto& row : rules["reads"]) {
    const std::string tag = "&row=" + std::to_string(n++), path = row["path"].get<std::string>() + tag;
    CAPTURE(path);
    const Outcome outcome = read_from(server.url(path), options, time.clock());
    const std::string fails = row.value("fails", "");
    CHECK(outcome.opened == (fails != "open_failed"));
    CHECK((outcome.status ? "" : errc_name(outcome.status.error().code)) == fails);
    if (row.contains("status") && !outcome.status) CHECK(outcome.status.error().found == row["status"]);
    CHECK(server.requests(tag + " ") == row["requests"]);
  }
  for (const auto& row : rules["pauses"])
    CHECK(detail::retry_pause(row["failures"], row["retry_after"], row["random"]) == row["seconds"]);
}

TEST_CASE("an error's status may be any, and its body is not awaited") {
  const HostileServer server;
  CHECK(read_from(server.url("/status?code=999")).status.error().found == 999);
  CHECK_FALSE(read_from(server.url("/endless-error?code=404")).status);
}

TEST_CASE("a temporary status is retried as often as configured") {
  const HostileServer server;
  UrlOptions options = patient();
  for (const int retries : {0, 2}) {
    options.retries = retries;
    const std::string path = "/status?from=2&code=503&retries=" + std::to_string(retries);
    CHECK_FALSE(read_from(server.url(path), options).status);
    CHECK(server.requests(path + " ") == 2 + retries);
  }
}

TEST_CASE("an interrupted body is continued where it ended") {
  const HostileServer server;
  for (const char* kind : {"truncated", "truncated-chunked", "reset"}) {
    CAPTURE(std::string(kind));
    const std::string path = std::string("/") + kind + "?from=2&times=1";
    CHECK(read_from(server.url(path)).status);
    CHECK(server.requests(path + " ") == 3);
    CHECK(server.requests(path + " range=bytes=100000-199999 ") == 1);
    CHECK(server.requests(path + " range=bytes=150000-199999 ") == 1);
  }
}

TEST_CASE("headers may be long, but not endless or missing") {
  const HostileServer server;
  for (const std::string path :
       {"/long-line?", "/many-lines?", "/many-lines?n=100&", "/many-informations?", "/garbage?", "/no-header-colon?"}) {
    for (const int from : {1, 2}) {
      CAPTURE(path);
      CAPTURE(from);
      const Outcome outcome = read_from(server.url(path + "from=" + std::to_string(from)));
      REQUIRE_FALSE(outcome.status);
      CHECK(outcome.status.error().code == (outcome.opened ? Errc::read_failed : Errc::open_failed));
      CHECK(outcome.opened == (from == 2));
    }
  }
}

namespace {

constexpr double kStall = 20;  // seconds

// A source with a clock of its own, and its server, which the test answers by hand.
struct Timed {
  explicit Timed(int retries) {
    UrlOptions options = patient();
    options.retries = retries;
    options.stall_seconds = kStall;
    auto opening = std::async(std::launch::async,
                              [&, options] { return detail::open_url_source(server.url(), options, time.clock()); });
    peer = server.accept();
    CHECK(peer->asks("bytes=0-65535"));
    peer->send(head(0, kBeginning) + bytes(0, kBeginning));
    source = opening.get().value();
    reading = std::async(std::launch::async, [&] {
      std::vector<std::byte> read(kBytes);
      Status status = source->read(kFrom, read);
      if (status) CHECK(are_bytes_from(kFrom, read));
      return status;
    });
    CHECK(peer->asks("bytes=100000-199999"));
  }

  static std::string head(std::uint64_t begin, std::uint64_t end) {
    return "HTTP/1.1 206 whatever\r\nContent-Range: bytes " + std::to_string(begin) + "-" + std::to_string(end - 1) +
           "/" + std::to_string(kSize) + "\r\nContent-Length: " + std::to_string(end - begin) + "\r\n\r\n";
  }
  static std::string bytes(std::uint64_t begin, std::uint64_t end) {
    std::string text;
    for (; begin < end; ++begin) text += static_cast<char>(test::byte_at(begin));
    return text;
  }
  // The source has read it when this returns.
  void send(const std::string& text) {
    peer->send(text);
    time.advance(0);
  }
  void expect_again(const std::string& range) {
    CHECK(peer->is_left());
    peer = server.accept();
    CHECK(peer->asks(range));
  }
  // A late answer is requested again over another connection.
  void stall(const std::string& range, double after = kStall) {
    time.advance(after);
    time.advance(0.25);
    expect_again(range);
  }

  test::HandServer server;
  UrlTime time;
  std::unique_ptr<Peer> peer;
  std::unique_ptr<ByteSource> source;
  std::future<Status> reading;
};

}  // namespace

TEST_CASE("a slow server is not a stalled one, and a stalled answer is continued where it ended") {
  Timed timed(1);
  timed.send(Timed::head(100000, 200000) + Timed::bytes(100000, 101000));
  for (std::uint64_t begin = 101000; begin < 101500; begin += 100) {
    timed.time.advance(0.9 * kStall);
    timed.send(Timed::bytes(begin, begin + 100));
  }
  timed.stall("bytes=101500-199999");
  timed.send(Timed::head(101500, 200000) + Timed::bytes(101500, 200000));
  CHECK(timed.reading.get());
}

TEST_CASE("a silent server, or one that never ends a header, is retried as often as configured") {
  for (const bool has_lines : {false, true}) {
    CAPTURE(has_lines);
    Timed timed(1);
    if (has_lines) {
      timed.send("HTTP/1.1 206 whatever\r\n");
      timed.time.advance(0.9 * kStall);
      timed.send("X-Nothing: nothing\r\n");
    }
    timed.stall("bytes=100000-199999", has_lines ? 0.11 * kStall : kStall);
    timed.time.advance(kStall);
    const Status read = timed.reading.get();
    REQUIRE_FALSE(read);
    CHECK(read.error().code == Errc::read_failed);
    CHECK(read.error().offset == kFrom);
    CHECK(has(read.error().what, "in time"));
  }
}

TEST_CASE("opening ends at its limit, whatever the server does, and later reads have none") {
  UrlOptions options = untiring();
  options.stall_seconds = kStall;
  options.open_seconds = 2.5 * kStall;
  // Silent; a byte now and then; busy for long; redirects without end.
  const std::string busy = "HTTP/1.1 503 whatever\r\nRetry-After: 99999999\r\nContent-Length: 0\r\n\r\n";
  for (const std::string& said : {std::string(), Timed::head(0, kBeginning), busy}) {
    CAPTURE(said);
    const test::HandServer server;
    UrlTime time;
    auto opening =
        std::async(std::launch::async, [&] { return detail::open_url_source(server.url(), options, time.clock()); });
    const auto peer = server.accept();
    CHECK(peer->asks("bytes=0-65535"));
    peer->send(said);
    for (int i = 0; i < 4; ++i) {
      time.advance(0.5 * kStall);
      if (said.starts_with("HTTP/1.1 206")) peer->send("x");
    }
    time.advance_last(0.5 * kStall);
    const auto source = opening.get();
    REQUIRE_FALSE(source);
    CHECK(source.error().code == Errc::open_failed);
    CHECK(has(source.error().what, "longer than allowed"));
  }
  const HostileServer redirects;
  options.most_redirects = std::numeric_limits<int>::max();
  options.open_seconds = 0.01;
  const auto source = open_url_source(redirects.url("/loop"), options);
  REQUIRE_FALSE(source);
  CHECK(has(source.error().what, "longer than allowed"));

  Timed timed(std::numeric_limits<int>::max());
  timed.time.advance(86400);  // the limit of opening is over
  timed.time.advance(0.25);
  timed.expect_again("bytes=100000-199999");
  timed.source->set_limit(1);
  timed.time.advance(0);
  timed.time.advance(1);
  const Status read = timed.reading.get();
  REQUIRE_FALSE(read);
  CHECK(read.error().code == Errc::read_failed);
  CHECK(read.error().offset == kFrom);
  std::vector<std::byte> bytes(kBytes);
  CHECK(has(timed.source->read(kFrom, bytes).error().what, "longer than allowed"));
  timed.source->set_limit(std::numeric_limits<double>::infinity());
  timed.reading = std::async(std::launch::async, [&] { return timed.source->read(kFrom, bytes); });
  timed.peer = timed.server.accept();
  CHECK(timed.peer->asks("bytes=100000-199999"));
  timed.send(Timed::head(100000, 200000) + Timed::bytes(100000, 200000));
  CHECK(timed.reading.get());
  CHECK(are_bytes_from(kFrom, bytes));
}

TEST_CASE("pauses between attempts grow, and are at least as long as the server says") {
  Timed timed(3);
  const auto comes_after = [&](double least, double most, const std::string& fields) {
    timed.send("HTTP/1.1 503 whatever\r\nContent-Length: 0\r\n" + fields + "\r\n");
    timed.time.advance(0.99 * least);
    CHECK_FALSE(timed.server.has_connection());
    timed.time.advance(most - 0.99 * least);
    timed.expect_again("bytes=100000-199999");
  };
  // Between three quarters and all of the pause, so that clients do not return together.
  comes_after(0.75 * 0.25, 0.25, "");
  comes_after(0.75 * 0.5, 0.5, "");
  comes_after(3, 3, "Retry-After: 3\r\n");
  timed.send(Timed::head(100000, 200000) + Timed::bytes(100000, 200000));
  CHECK(timed.reading.get());
}

TEST_CASE("redirects are followed up to a limit, only to safe places, and resolved once") {
  const HostileServer server, other;
  UrlOptions options = patient();
  for (const int code : {301, 302, 303, 307, 308}) {
    CAPTURE(code);
    const std::string path = "/redirect?code=" + std::to_string(code) + "&to=" + other.url("/plain");
    CHECK(read_from(server.url(path)).status);
    CHECK(server.requests(path + " ") == 1);
  }
  CHECK(other.requests("range=bytes=100000-199999 ") == 5);
  CHECK(read_from(server.url("/chain?n=5")).status);
  const int before = server.requests();
  const Outcome chain = read_from(server.url("/chain?n=6"));
  CHECK(has(chain.what(), "redirects too often"));
  CHECK(server.requests() == before + 6);
  CHECK(has(read_from(server.url("/loop")).what(), "redirects too often"));
  options.most_redirects = 0;
  CHECK(has(read_from(server.url("/chain?n=1"), options).what(), "redirects too often"));
  for (const char* to : {"file:///etc/passwd", "ftp://127.0.0.1/x", "gopher://127.0.0.1/", "", "http://",
                         "javascript:1", "dict://127.0.0.1/"}) {
    CAPTURE(std::string(to));
    const Outcome outcome = read_from(server.url(std::string("/redirect?to=") + to));
    REQUIRE_FALSE(outcome.status);
    CHECK(has(outcome.what(), "invalid web address"));
    CHECK(outcome.status.error().found == 302);
  }
  CHECK_FALSE(read_from(server.url("/redirect-nowhere")).status);
  CHECK(read_from(server.url("/endless-redirect?to=/plain")).status);
  CHECK(read_from(server.url("/redirect?to=//" + other.host() + "/plain")).status);
  CHECK(read_from(server.url("/redirect?from=2&to=/plain?moved")).status);  // in the middle
}

TEST_CASE("if a redirect's target expires, the first address is requested again") {
  const HostileServer server;
  const std::string path = "/redirect?to=/status?code=403%26from=3%26times=1";
  const auto source = open_url_source(server.url(path), patient()).value();
  CHECK(reads_right(*source, kFrom, kBytes));
  CHECK(server.requests(path + " ") == 1);
  CHECK(reads_right(*source, kFrom + 5, kBytes));
  CHECK(server.requests(path + " ") == 2);
  const auto lost = open_url_source(server.url("/redirect?to=/status?code=403%26from=2"), patient()).value();
  std::vector<std::byte> bytes(10);
  CHECK(lost->read(kFrom, bytes).error().found == 403);
  CHECK(server.requests("/status?code=403&from=2 ") == 3);
}

TEST_CASE("another host gets no password") {
  const HostileServer server, other;
  const auto with_user = [&](const std::string& path) { return "http://me:secret@" + server.host() + path; };
  CHECK(read_from(with_user("/plain")).status);
  CHECK(server.requests("auth=Basic") == 2);
  CHECK(read_from(with_user("/redirect?to=" + other.url("/plain"))).status);
  CHECK(server.requests("auth=Basic") == 3);
  CHECK(other.requests() == 2);
  CHECK(other.requests("auth= ") == 2);
  CHECK(read_from(server.url("/plain?after")).status);
  CHECK(server.requests("auth=Basic") == 3);
}

TEST_CASE("the environment's proxy is used") {
  const HostileServer proxy;
  ::setenv("http_proxy", proxy.url("").c_str(), 1);
  const Outcome outcome = read_from("http://roofgs.invalid/plain");
  ::unsetenv("http_proxy");
  CHECK(outcome.status);
  CHECK(proxy.requests("GET http://roofgs.invalid/plain range=") == 2);
}

TEST_CASE("cancelling wakes readers at every stage") {
  const HostileServer server;
  for (const char* path :
       {"/stall?from=2", "/silent?from=2", "/status?from=2&code=503", "/slow?rate=1", "/slow-head?from=2"}) {
    CAPTURE(std::string(path));
    UrlOptions options = untiring();
    options.reads_at_once = 2;
    const auto source = open_url_source(server.url(path), options).value();
    std::array<Errc, 4> codes{};
    std::vector<std::thread> readers;
    for (Errc& code : codes) {
      readers.emplace_back([&] {
        std::vector<std::byte> bytes(kBytes);
        const Status read = source->read(kFrom, bytes);
        code = read ? Errc::internal : read.error().code;
      });
    }
    test::await([&] { return server.requests(path) >= 3; });  // two are in flight
    source->cancel();
    for (std::thread& reader : readers) reader.join();
    for (const Errc code : codes) CHECK(code == Errc::cancelled);
    std::vector<std::byte> bytes(10);
    CHECK(source->read(0, bytes).error().code == Errc::cancelled);
    CHECK(source->read(kFrom, bytes).error().code == Errc::cancelled);
    CHECK(source->size() == kSize);
    source->cancel();
  }
}

TEST_CASE("a request to stop ends opening and reads at every stage") {
  const HostileServer server;
  const auto stopped = [](const Result<std::unique_ptr<ByteSource>>& source) {
    return !source && source.error().code == Errc::cancelled;
  };
  for (const std::string path : {"/stall?", "/silent?", "/status?code=503&", "/slow?all=1&rate=1&", "/slow-head?"}) {
    CAPTURE(path);
    std::stop_source stop;
    UrlOptions options = untiring();
    options.stop = stop.get_token();
    std::thread stopper([&] {
      test::await([&] { return server.requests(path) > 0; });
      stop.request_stop();
    });
    CHECK(stopped(open_url_source(server.url(path), options)));
    stopper.join();
    CHECK(stopped(open_url_source(server.url(path + "again=1"), options)));  // stopped before it starts
  }
  std::stop_source stop;
  UrlOptions options;
  options.stop = stop.get_token();
  const auto source = open_url_source(server.url("/plain"), options).value();
  CHECK(reads_right(*source, kFrom, kBytes));
  stop.request_stop();
  std::vector<std::byte> bytes(10);
  CHECK(source->read(kFrom, bytes).error().code == Errc::cancelled);
  CHECK(server.requests("again") == 0);
}

TEST_CASE("an address without a server, and an invalid one, fail at once") {
  const auto code_of = [](const std::string& url, const UrlOptions& options = {}) {
    const auto source = open_url_source(url, options);
    REQUIRE_FALSE(source);
    return source.error().code;
  };
  for (const char* url :
       {"", "scene.rgs", "ftp://127.0.0.1/x", "file:///etc/passwd", "http://", "https://", "http://127.0.0.1:99999/x",
        "http://127.0.0.1:x/", "http://a b/", "http://[::1/x", "http://127.0.0.1/a b"}) {
    CAPTURE(std::string(url));
    CHECK(code_of(url) == Errc::bad_argument);
  }
  const test::ReservedPort port;  // where nobody listens
  const std::string nobody = "127.0.0.1:" + std::to_string(port.number()) + "/scene.rgs";
  CHECK(code_of("http://" + nobody, patient()) == Errc::open_failed);
  CHECK(open_url_source("http://" + nobody, patient()).error().system == ECONNREFUSED);
  CHECK(code_of("https://" + nobody, patient()) == Errc::open_failed);
  const HostileServer server;
  UrlOptions impatient = patient();
  impatient.connect_seconds = 0.1;  // the server, which waits for the rest of a request, does not speak TLS
  CHECK(code_of("https://" + server.host() + "/plain", impatient) == Errc::open_failed);
  const auto with = [&](auto UrlOptions::*field, auto value) {
    UrlOptions options;
    options.*field = value;
    return options;
  };
  for (const UrlOptions& options :
       {with(&UrlOptions::reads_at_once, 0), with(&UrlOptions::reads_at_once, 65), with(&UrlOptions::retries, -1),
        with(&UrlOptions::most_redirects, -1), with(&UrlOptions::open_seconds, 0.),
        with(&UrlOptions::connect_seconds, 0.), with(&UrlOptions::stall_seconds, -1.),
        with(&UrlOptions::stall_seconds, std::numeric_limits<double>::quiet_NaN()),
        with(&UrlOptions::connect_seconds, 1e300)}) {
    CHECK(code_of(server.url("/plain"), options) == Errc::bad_argument);
  }
  CHECK(code_of(server.url("/plain"), with(&UrlOptions::certificates, std::string("/no/such/file"))) ==
        Errc::open_failed);
  CHECK(server.requests() == 0);
}

TEST_CASE("sources leave nothing behind") {
  const HostileServer server;
  const auto open_files = [] {
    return std::distance(std::filesystem::directory_iterator("/proc/self/fd"), std::filesystem::directory_iterator());
  };
  const auto use = [&] {
    const auto source = open_url_source(server.url("/plain"), patient()).value();
    CHECK(reads_right(*source, kFrom, 1000));
    (void)open_url_source(server.url("/status?code=404"), patient());
    (void)open_url_source(server.url("/garbage"), patient());
  };
  use();
  const auto before = open_files();
  for (int i = 0; i < 5; ++i) use();
  CHECK(open_files() == before);
}
