// http_server.hpp - HTTP on the loopback address: limits on what is read, and answers that are values.
// SPDX-License-Identifier: Apache-2.0
//
// cpp-httplib parses and writes. What its version 0.11 does not do is done here: a request's head and body end at a size and at a time,
// ranges are ours, and what was refused unread ends the connection.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "rgs/result.hpp"
#include "served_file.hpp"

namespace rgs::view {

struct HttpLimits {
  std::size_t head_bytes = 8192, body_bytes = 65536;
  std::chrono::milliseconds request_time{10'000};  ///< for a head from its first byte, and again for its body
  std::chrono::milliseconds idle_time{5'000};      ///< for a connection's next request
  std::chrono::milliseconds stall_time{30'000};    ///< without a byte that a client takes
};

/// A request whose head has been read. The path is decoded and without its query.
struct HttpRequest {
  std::string method, path, body;
  std::vector<std::pair<std::string, std::string>> fields;

  /// The value of a field that is there once, case of its name aside; empty if it is there twice or not at all.
  std::string field(std::string_view name) const;
  std::size_t count(std::string_view name) const;
};

struct HttpAnswer {
  int status = 200;
  std::vector<std::pair<std::string, std::string>> fields = {};  ///< names once each
  std::string type = {};                                         ///< Content-Type; empty without content
  std::string body = {};
  /// In place of `body`: bytes [first, first + count) of it.
  std::shared_ptr<const OpenFile> file = nullptr;
  std::uint64_t first = 0, count = 0;
};

struct HttpHandlers {
  /// From the head alone: what is answered without reading the body, if it is refused. The connection ends with it.
  std::function<std::optional<HttpAnswer>(const HttpRequest&)> refuse;
  /// Called by several threads at once. What it throws becomes an answer of 500.
  std::function<HttpAnswer(const HttpRequest&)> answer;
  /// For a request that cannot be understood, and for one that failed: with `status`.
  std::function<HttpAnswer(int status)> fail;
};

class HttpServer {
 public:
  /// Listens on 127.0.0.1, at a free port if `port` is 0. Error: open_failed (the port is taken).
  static Result<HttpServer> listen(int port, const HttpLimits& limits = {});
  HttpServer(HttpServer&&) noexcept;
  HttpServer& operator=(HttpServer&&) noexcept;
  ~HttpServer();

  int port() const;
  /// Serves until stop(), which another thread may call. Returns when all connections are closed.
  void serve(const HttpHandlers& handlers);
  void stop();

 private:
  struct Impl;
  explicit HttpServer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::view
