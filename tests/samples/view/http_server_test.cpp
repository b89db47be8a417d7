// http_server_test.cpp - limits of the server: heads, bodies, time. SPDX-License-Identifier: Apache-2.0
#include "http_server.hpp"

#include <arpa/inet.h>
#include <doctest/doctest.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <deque>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <string_view>
#include <thread>

#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace std::chrono_literals;
using rgs::view::HttpAnswer;
using rgs::view::HttpHandlers;
using rgs::view::HttpLimits;
using rgs::view::HttpRequest;
using rgs::view::HttpServer;

namespace {

// Echoes the request; refuses "/no".
HttpHandlers echo() {
  return {.refuse = [](const HttpRequest& request) -> std::optional<HttpAnswer> {
            if (request.path != "/no") return std::nullopt;
            return HttpAnswer{.status = 403, .type = "text/plain", .body = "refused"};
          },
          .answer =
              [](const HttpRequest& request) {
                if (request.path == "/throw") throw std::runtime_error("on purpose");
                return HttpAnswer{.type = "text/plain",
                                  .body = request.method + ' ' + request.path + " range=" + request.field("range") +
                                          " body=" + std::to_string(request.body.size())};
              },
          .fail = [](int status) { return HttpAnswer{.status = status, .type = "text/plain", .body = "failed"}; }};
}

// No time limit applies, however slow the machine.
HttpLimits patient() {
  return {.request_time = 24h, .idle_time = 24h, .stall_time = 24h};
}

class Running {
 public:
  explicit Running(const HttpHandlers& handlers, const HttpLimits& limits = patient())
      : server_(HttpServer::listen(0, limits).value()), thread_([this, handlers] { server_.serve(handlers); }) {}
  ~Running() {
    server_.stop();
    thread_.join();
  }
  int port() const { return server_.port(); }

 private:
  HttpServer server_;
  std::thread thread_;
};

class Client {
 public:
  explicit Client(int port) : fd_(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    const int few_bytes = 65536;
    ::setsockopt(fd_, SOL_SOCKET, SO_RCVBUF, &few_bytes, sizeof few_bytes);
    sockaddr_in a{};
    a.sin_family = AF_INET;
    a.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    a.sin_port = htons(static_cast<std::uint16_t>(port));
    if (::connect(fd_, reinterpret_cast<sockaddr*>(&a), sizeof a) != 0) throw std::runtime_error("cannot connect");
  }
  ~Client() { ::close(fd_); }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  void send(std::string_view text) const {
    while (!text.empty()) {
      const ssize_t n = ::send(fd_, text.data(), text.size(), MSG_NOSIGNAL);
      if (n <= 0) return;  // the server has closed
      text.remove_prefix(static_cast<std::size_t>(n));
    }
  }
  bool has_answer() const {
    pollfd wanted{fd_, POLLIN, 0};
    return ::poll(&wanted, 1, 1) > 0;
  }
  void end() const { ::shutdown(fd_, SHUT_WR); }
  // The received bytes, once there are any; empty when the server has closed.
  std::string next() const {
    std::array<char, 4096> bytes;
    const ssize_t n = ::recv(fd_, bytes.data(), bytes.size(), 0);
    return std::string(bytes.data(), static_cast<std::size_t>(std::max<ssize_t>(n, 0)));
  }
  // Everything until the server closes.
  std::string rest() const {
    std::string text;
    for (std::string part; !(part = next()).empty();) text += part;
    return text;
  }

 private:
  int fd_;
};

std::string ask(int port, std::string_view request) {
  const Client client(port);
  client.send(request);
  client.end();
  return client.rest();
}

bool has(const std::string& text, std::string_view part) {
  return text.find(part) != text.npos;
}

}  // namespace

TEST_CASE("a connection answers one request after the other, with and without bodies") {
  const Running server(echo());
  const std::string said = ask(server.port(),
                               "GET /one HTTP/1.1\r\nHost: a\r\n\r\nPOST /two HTTP/1.1\r\nContent-Length: "
                               "3\r\n\r\nabcGET /three HTTP/1.1\r\n\r\n");
  CHECK(has(said, "GET /one range= body=0"));
  CHECK(has(said, "POST /two range= body=3"));
  CHECK(has(said, "GET /three range= body=0"));
}

TEST_CASE("HEAD gets no body, and a body that is waited for is asked for") {
  const Running server(echo());
  const std::string head = ask(server.port(), "HEAD /a%2fb?q#f HTTP/1.1\r\n\r\nGET /next HTTP/1.1\r\n\r\n");
  CHECK(has(head, "Content-Length: 23\r\n"));  // of "HEAD /a/b range= body=0"
  CHECK(!has(head, "HEAD /a/b"));
  CHECK(has(head, "GET /next"));
  const Client client(server.port());
  client.send("POST /a HTTP/1.1\r\nContent-Length: 3\r\nExpect: 100-Continue\r\n\r\n");
  CHECK(client.next() == "HTTP/1.1 100 Continue\r\n\r\n");
  client.send("abc");
  CHECK(has(client.next(), "body=3"));
}

TEST_CASE("ranges reach the handler unchanged, and nothing else answers them") {
  const Running server(echo());
  for (const char* range : {"bytes=5-3", "bytes=99999999999999999999-", "bytes=0-1,2-3", "nonsense"}) {
    for (const char* name : {"Range", "range", "RANGE"}) {
      const std::string said =
          ask(server.port(), std::string("GET /a HTTP/1.1\r\n") + name + ": " + range + "\r\n\r\n");
      CHECK(said.starts_with("HTTP/1.1 200 "));
      CHECK(has(said, std::string("GET /a range=") + range + " body=0"));
    }
  }
}

TEST_CASE("a header that is too large, or invalid, is refused and ends the connection") {
  const Running server(echo());
  const std::string many = "bytes=" + std::string(7900, '1');
  CHECK(has(ask(server.port(), "GET /a HTTP/1.1\r\nRange: " + many + "\r\n\r\n"), "range=" + many));
  CHECK(
      ask(server.port(), "GET /a HTTP/1.1\r\nX: " + std::string(9000, 'x') + "\r\n\r\n").starts_with("HTTP/1.1 431 "));
  CHECK(ask(server.port(), std::string(20'000, 'x')).starts_with("HTTP/1.1 431 "));
  std::string fields;
  for (int i = 0; i < 2000; ++i) fields += "A: b\r\n";
  CHECK(ask(server.port(), "GET /a HTTP/1.1\r\n" + fields + "\r\n").starts_with("HTTP/1.1 431 "));
  for (const std::string& head : {std::string("GET /a\r\n\r\n"), std::string("BREW /a HTTP/1.1\r\n\r\n"),
                                  std::string("GET /a HTTP/1.1\r\nX: y\nRange: bytes=1-2\r\n\r\n"),
                                  std::string("GET /a HTTP/1.1\r\nX: \0\r\n\r\n", 25)}) {
    const std::string said = ask(server.port(), head + "GET /second HTTP/1.1\r\n\r\n");
    CHECK(said.starts_with("HTTP/1.1 400 "));
  }
  // With bare line feeds a header could end earlier for one reader than for another.
  CHECK(!has(ask(server.port(), "GET /a HTTP/1.1\r\nX: y\n\r\nGET /smuggled HTTP/1.1\r\n\r\n"), "smuggled"));
}

TEST_CASE("bodies end at their limit, and those of refused requests are not parsed as requests") {
  HttpLimits limits = patient();
  limits.body_bytes = 1000;
  const Running server(echo(), limits);
  const auto post = [&](const std::string& path, std::size_t stated, std::size_t sent) {
    return ask(server.port(), "POST " + path + " HTTP/1.1\r\nContent-Length: " + std::to_string(stated) + "\r\n\r\n" +
                                  std::string(sent, 'x'));
  };
  CHECK(has(post("/a", 1000, 1000), "body=1000"));
  CHECK(post("/a", 1001, 1001).starts_with("HTTP/1.1 4"));
  CHECK(post("/a", 1'000'000'000'000, 100).starts_with("HTTP/1.1 4"));
  CHECK(post("/a", 10, 5).starts_with("HTTP/1.1 4"));  // ends early
  CHECK(
      ask(server.port(), "POST /a HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n").starts_with("HTTP/1.1 4"));
  const std::string inner = "GET /inner HTTP/1.1\r\n\r\n";
  // Invalid sizes: the end of such a body is unknown. Without a body the connection ends too.
  struct Refused {
    std::string fields, status;
  };
  for (const Refused& refused : {Refused{"Content-Length: 24\r\n", "403"},
                                 {"Transfer-Encoding: chunked\r\n", "403"},
                                 {"Content-Length: 0\r\nContent-Length: 24\r\n", "400"},
                                 {"Content-Length: 0x18\r\n", "400"},
                                 {"", "403"}}) {
    CAPTURE(refused.fields);
    const std::string said = ask(server.port(), "POST /no HTTP/1.1\r\n" + refused.fields + "\r\n" + inner);
    CHECK(said.starts_with("HTTP/1.1 " + refused.status + ' '));
    CHECK(has(said, "Connection: close"));
    CHECK(!has(said, "/inner"));
  }
}

TEST_CASE("others are served while a client does not end its request, or sends none") {
  const Running server(echo());
  const Client silent(server.port()), slow(server.port()), body(server.port());
  slow.send("GET /slow HTT");
  body.send("POST /body HTTP/1.1\r\nContent-Length: 100\r\n\r\nhalf");
  CHECK(has(ask(server.port(), "GET /quick HTTP/1.1\r\n\r\n"), "GET /quick"));
}

TEST_CASE("others are served while hundreds of clients send nothing, half a request, or refused ones and stay") {
  const Running server(echo());
  for (const char* const said : {"", "GET /slow HTT", "GET /no HTTP/1.1\r\n\r\n"}) {
    CAPTURE(std::string(said));
    std::deque<Client> clients;
    for (int i = 0; i < 600; ++i) {
      clients.emplace_back(server.port());
      clients.back().send(said);
    }
    CHECK(has(ask(server.port(), "GET /quick HTTP/1.1\r\n\r\n"), "GET /quick"));
    // Of those that wait the oldest was closed for the others.
    if (std::string_view(said).find("/no") == std::string_view::npos) CHECK(clients.front().rest().empty());
  }
  // A request that is being answered is not one that waits.
  const Client body(server.port());
  body.send("POST /body HTTP/1.1\r\nContent-Length: 4\r\n\r\nha");
  std::deque<Client> clients;
  for (int i = 0; i < 200; ++i) clients.emplace_back(server.port());
  CHECK(clients.front().rest().empty());
  body.send("lf");
  CHECK(has(body.next(), "200 OK"));
}

TEST_CASE("a client that never ends its request is disconnected") {
  HttpLimits limits = patient();
  limits.request_time = 1ms;
  const Running server(echo(), limits);
  const Client slow(server.port()), body(server.port());
  slow.send("GET /slow HTT");
  body.send("POST /body HTTP/1.1\r\nContent-Length: 100\r\n\r\nhalf");
  CHECK(slow.rest().starts_with("HTTP/1.1 408 "));
  CHECK(body.rest().starts_with("HTTP/1.1 4"));
  limits = patient();
  limits.idle_time = 1ms;
  const Running impatient(echo(), limits);
  CHECK(Client(impatient.port()).rest().empty());
}

TEST_CASE("a client that sends a byte now and then gets no more time than others") {
  HttpLimits limits = patient();
  limits.request_time = 100ms;
  limits.head_bytes = std::size_t{1} << 40;
  const Running server(echo(), limits);
  const Client client(server.port());
  client.send("GET /a HTTP/1.1\r\n");
  while (!client.has_answer()) client.send("x");
  CHECK(client.rest().starts_with("HTTP/1.1 408 "));
}

TEST_CASE("an exception becomes an answer, and the server continues") {
  const Running server(echo());
  const std::string said = ask(server.port(), "GET /throw HTTP/1.1\r\n\r\nGET /after HTTP/1.1\r\n\r\n");
  CHECK(said.starts_with("HTTP/1.1 500 "));
  CHECK(!has(said, "on purpose"));
  CHECK(has(said, "GET /after"));
}

TEST_CASE("a file that changes while it is sent ends the connection before its last byte") {
  const rgs::test::TemporaryFolder folder;
  const std::string path = folder.file("large.bin");
  constexpr std::size_t kBytes = 32 << 20;  // more than the two sockets hold
  rgs::test::write_text(path, std::string(kBytes, 'a'));
  std::filesystem::last_write_time(path, std::filesystem::file_time_type::clock::now() - std::chrono::hours(1));
  const auto file = rgs::view::ServedFile::look(path);
  REQUIRE(file);
  HttpHandlers handlers = echo();
  handlers.answer = [&](const HttpRequest&) {
    const auto open = file->open();
    return HttpAnswer{.type = "application/octet-stream", .file = open.value(), .count = file->size()};
  };
  const Running server(handlers);
  const Client client(server.port());
  client.send("GET /f HTTP/1.1\r\n\r\n");
  const std::string begin = client.next();  // it has opened the file
  // The server waits for room once the socket is full; the part not read by then is from the new file.
  rgs::test::write_text(path, std::string(kBytes, 'b'));
  const std::string text = begin + client.rest();
  const std::size_t head = text.find("\r\n\r\n");
  REQUIRE(head != text.npos);
  CHECK(has(text.substr(0, head), "Content-Length: " + std::to_string(kBytes)));
  CHECK(text.size() - head - 4 < kBytes);
  CHECK(text.find('b', head + 4) == text.npos);
}

TEST_CASE("a port in use is refused") {
  const Running server(echo());
  ask(server.port(), "GET /a HTTP/1.1\r\n\r\n");
  const auto second = HttpServer::listen(server.port());
  REQUIRE(!second);
  CHECK(second.error().code == rgs::Errc::open_failed);
}
