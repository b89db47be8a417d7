// http_server.hpp - an HTTP server on the loopback address, with limits on requests; ranges are for the handlers.
// SPDX-License-Identifier: Apache-2.0
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
  std::chrono::milliseconds request_time{10'000};  ///< for a head from its first byte, and then for its body
  std::chrono::milliseconds idle_time{5'000};      ///< until a connection's next request; less when many wait
  std::chrono::milliseconds stall_time{30'000};    ///< while the client takes no byte
};

/// `path` is decoded and has no query.
struct HttpRequest {
  std::string method, path, body;
  std::vector<std::pair<std::string, std::string>> fields;

  /// The value of a field that occurs once, by name without case; else empty.
  std::string field(std::string_view name) const;
  std::size_t count(std::string_view name) const;
};

struct HttpAnswer {
  int status = 200;
  std::vector<std::pair<std::string, std::string>> fields = {};  ///< each name once
  std::string type = {};                                         ///< Content-Type; empty if there is no content
  std::string body = {};
  /// Instead of `body`: bytes [first, first + count) of this file.
  std::shared_ptr<const OpenFile> file = nullptr;
  std::uint64_t first = 0, count = 0;
};

struct HttpHandlers {
  /// Sees the head only. An answer refuses the request: its body is not read, and the connection closes.
  std::function<std::optional<HttpAnswer>(const HttpRequest&)> refuse;
  /// Called by several threads at once. An exception becomes an answer of 500.
  std::function<HttpAnswer(const HttpRequest&)> answer;
  /// Makes the answer for a malformed request or a failure, with `status`.
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
  /// Serves until stop(), which another thread may call. Then no handler is called, and connections close with the server.
  void serve(const HttpHandlers& handlers);
  void stop();

 private:
  struct Impl;
  explicit HttpServer(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace rgs::view
