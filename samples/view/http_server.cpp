// http_server.cpp - cpp-httplib behind limits.
// SPDX-License-Identifier: Apache-2.0
#include "http_server.hpp"

#include <httplib.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <span>
#include <string_view>
#include <utility>

namespace rgs::view {
namespace {

using Clock = std::chrono::steady_clock;

// A browser opens six connections to a server, and two pages may be open.
constexpr std::size_t kThreads = 16;
constexpr std::size_t kRequestsOfConnection = 10'000;
constexpr std::size_t kFileBlock = 256 * 1024;
// Bytes that are read from a refused client before the connection closes, so that it can read the answer.
constexpr std::size_t kLingerBytes = 1 << 20;
constexpr std::chrono::milliseconds kLingerTime{500};

// Replaces the name Range, so that httplib does not handle ranges itself: it answers 416 to numbers beyond 2^63, and copies each of
// several ranges into memory.
constexpr std::string_view kRange = "Range", kSeenRange = "Bytes";
static_assert(kRange.size() == kSeenRange.size());

bool equal_names(std::string_view a, std::string_view b) {
  const auto lower = [](char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; };
  return a.size() == b.size() &&
         std::equal(a.begin(), a.end(), b.begin(), [&](char x, char y) { return lower(x) == lower(y); });
}

// Waits until the socket can be read or written. False at time `until`.
bool wait_for(int socket, short event, Clock::time_point until) {
  for (;;) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now()).count();
    if (left <= 0) return false;
    pollfd wanted{socket, event, 0};
    const int n = ::poll(&wanted, 1, static_cast<int>(std::min<std::int64_t>(left, 1 << 30)));
    if (n > 0) return true;
    if (n < 0 && errno != EINTR) return false;
  }
}

// A connection that httplib reads and writes, one request after the other.
class Connection final : public httplib::Stream {
 public:
  enum class Head { complete, closed, malformed, too_large, too_slow };

  Connection(int socket, const HttpLimits& limits) : socket_(socket), limits_(limits) {}

  // Reads a whole head, so that httplib never waits for one.
  Head read_head() {
    begin_ = 0;
    bytes_read_ = 0;
    Clock::time_point until = Clock::now() + (buffer_.empty() ? limits_.idle_time : limits_.request_time);
    bool began = !buffer_.empty();
    for (;;) {
      const std::size_t end = buffer_.find("\r\n\r\n");
      if (end != buffer_.npos && end + 4 <= limits_.head_bytes) {
        head_bytes_ = end + 4;
        until_ = Clock::now() + limits_.request_time;
        if (!has_plain_lines()) return Head::malformed;
        hide_ranges();
        return Head::complete;
      }
      if (buffer_.size() >= limits_.head_bytes) return Head::too_large;
      if (!wait_for(socket_, POLLIN, until)) return began ? Head::too_slow : Head::closed;
      if (!began) until = Clock::now() + limits_.request_time;
      began = true;
      if (!receive()) return Head::closed;
    }
  }

  bool is_readable() const override { return true; }
  bool is_writable() const override { return true; }
  int socket() const override { return socket_; }
  // Unused: every client is on this machine.
  void get_remote_ip_and_port(std::string&, int&) const override {}
  void get_local_ip_and_port(std::string&, int&) const override {}

  ssize_t read(char* out, std::size_t size) override {
    if (bytes_read_ >= head_bytes_ + limits_.body_bytes) return -1;
    if (begin_ == buffer_.size()) {
      buffer_.clear();
      begin_ = 0;
      if (!wait_for(socket_, POLLIN, until_) || !receive()) return -1;
    }
    const std::size_t n = std::min(size, buffer_.size() - begin_);
    std::copy_n(buffer_.data() + begin_, n, out);
    begin_ += n;
    bytes_read_ += n;
    return static_cast<ssize_t>(n);
  }

  ssize_t write(const char* data, std::size_t size) override {
    for (;;) {
      const ssize_t n = ::send(socket_, data, size, MSG_NOSIGNAL | MSG_DONTWAIT);
      if (n >= 0) return n;
      if (errno == EINTR) continue;
      if (errno != EAGAIN || !wait_for(socket_, POLLOUT, Clock::now() + limits_.stall_time)) return -1;
    }
  }

  // Whether a body of this size has been read to its end.
  bool is_consumed(std::size_t body_bytes) const { return bytes_read_ == head_bytes_ + body_bytes; }
  void forget_request() { buffer_.erase(0, begin_); }

  // Lets the client read the answer while it is still sending.
  void linger() {
    ::shutdown(socket_, SHUT_WR);
    const auto until = Clock::now() + kLingerTime;
    for (std::size_t left = kLingerBytes; left > 0 && wait_for(socket_, POLLIN, until);) {
      buffer_.clear();
      if (!receive()) return;
      left -= std::min(left, buffer_.size());
    }
  }

 private:
  bool receive() {
    std::array<char, 16384> bytes;
    for (;;) {
      const ssize_t n = ::recv(socket_, bytes.data(), bytes.size(), 0);
      if (n < 0 && errno == EINTR) continue;
      if (n <= 0) return false;
      buffer_.append(bytes.data(), static_cast<std::size_t>(n));
      return true;
    }
  }

  // httplib ends a line at a bare line feed, and a text at a zero.
  bool has_plain_lines() const {
    for (std::size_t i = 0; i < head_bytes_; ++i)
      if (buffer_[i] == '\0' || (buffer_[i] == '\n' && (i == 0 || buffer_[i - 1] != '\r'))) return false;
    return true;
  }

  void hide_ranges() {
    for (std::size_t at = buffer_.find("\r\n"); at + 2 < head_bytes_; at = buffer_.find("\r\n", at + 2)) {
      const std::string_view line(buffer_.data() + at + 2, head_bytes_ - at - 2);
      if (line.size() > kRange.size() && line[kRange.size()] == ':' &&
          equal_names(line.substr(0, kRange.size()), kRange))
        buffer_.replace(at + 2, kSeenRange.size(), kSeenRange);
    }
  }

  int socket_;
  HttpLimits limits_;
  std::string buffer_;  // received; begin_ bytes of it have been read
  std::size_t begin_ = 0, head_bytes_ = 0, bytes_read_ = 0;
  Clock::time_point until_{};
};

HttpRequest request_of(const httplib::Request& from) {
  HttpRequest to{from.method, from.path, {}, {}};
  for (const auto& [name, value] : from.headers) to.fields.emplace_back(name == kSeenRange ? kRange : name, value);
  return to;
}

void fill(const HttpAnswer& from, httplib::Response& to) {
  to.status = from.status;
  for (const auto& [name, value] : from.fields) {
    to.headers.erase(name);
    to.set_header(name, value);
  }
  if (from.file == nullptr) {
    if (!from.type.empty()) to.set_content(from.body, from.type);
    return;
  }
  if (from.count == 0) return to.set_content("", from.type);
  to.set_content_provider(from.count, from.type,
                          [file = from.file, first = from.first, block = std::make_shared<std::string>()](
                              std::size_t offset, std::size_t length, httplib::DataSink& sink) {
                            block->resize(std::min(length, kFileBlock));
                            return file->read_at(first + offset, *block) && sink.write(block->data(), block->size());
                          });
}

// Content-Length.
std::size_t stated_body(const httplib::Request& request) {
  if (!request.has_header("Content-Length")) return 0;
  return static_cast<std::size_t>(std::strtoull(request.get_header_value("Content-Length").c_str(), nullptr, 10));
}

class Server final : public httplib::Server {
 public:
  explicit Server(const HttpLimits& limits) : limits_(limits) {
    new_task_queue = [] { return new httplib::ThreadPool(kThreads); };
    // Not SO_REUSEPORT as in httplib, which lets two programs share a port.
    set_socket_options([](int socket) {
      const int yes = 1;
      ::setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
    });
    set_keep_alive_max_count(kRequestsOfConnection);
    set_keep_alive_timeout(std::chrono::duration_cast<std::chrono::seconds>(limits.idle_time).count());
    set_payload_max_length(limits.body_bytes);
  }

  void use(const HttpHandlers& handlers) {
    handlers_ = handlers;
    set_pre_routing_handler([this](const httplib::Request& request, httplib::Response& response) {
      const HttpRequest head = request_of(request);
      if (const auto refusal = handlers_.refuse(head)) {
        fill(*refusal, response);
        response.set_header("Connection", "close");
        return HandlerResponse::Handled;
      }
      is_accepted_ = true;
      if (request.method == "POST") return HandlerResponse::Unhandled;
      fill(handlers_.answer(head), response);
      return HandlerResponse::Handled;
    });
    Post("(?:/[-\\w]{1,64}){1,4}",
         [this](const httplib::Request& request, httplib::Response& response, const httplib::ContentReader& reader) {
           HttpRequest whole = request_of(request);
           const bool complete = reader([&](const char* bytes, std::size_t n) {
             if (n > limits_.body_bytes - whole.body.size()) return false;
             whole.body.append(bytes, n);
             return true;
           });
           fill(complete ? handlers_.answer(whole) : handlers_.fail(400), response);
         });
    set_exception_handler([this](const httplib::Request&, httplib::Response& response, const std::exception_ptr&) {
      fill(handlers_.fail(500), response);
    });
    // httplib refuses heads that it cannot parse.
    set_error_handler(HandlerWithResponse([this](const httplib::Request&, httplib::Response& response) {
      if (!response.body.empty()) return HandlerResponse::Unhandled;
      fill(handlers_.fail(response.status), response);
      return HandlerResponse::Handled;
    }));
  }

 private:
  bool process_and_close_socket(int socket) override {
    const int yes = 1;
    ::setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    Connection connection(socket, limits_);
    serve(connection);
    connection.linger();
    ::close(socket);
    return true;
  }

  void serve(Connection& connection) {
    for (std::size_t n = 1; n <= kRequestsOfConnection && svr_sock_ >= 0; ++n) {
      switch (connection.read_head()) {
        case Connection::Head::complete: break;
        case Connection::Head::closed: return;
        case Connection::Head::malformed: return refuse(connection, 400, "Bad Request");
        case Connection::Head::too_large: return refuse(connection, 431, "Request Header Fields Too Large");
        case Connection::Head::too_slow: return refuse(connection, 408, "Request Timeout");
      }
      bool is_last = n == kRequestsOfConnection;
      std::size_t body_bytes = 0;
      const auto look = [&](httplib::Request& request) {
        body_bytes = stated_body(request);
        request.headers.erase("Accept-Encoding");  // compression takes longer than sending
      };
      is_accepted_ = false;
      if (!process_request(connection, is_last, is_last, look) || is_last || !is_accepted_ ||
          !connection.is_consumed(body_bytes))
        return;
      connection.forget_request();
    }
  }

  static void refuse(Connection& connection, int status, std::string_view reason) {
    const std::string answer = "HTTP/1.1 " + std::to_string(status) + ' ' + std::string(reason) +
                               "\r\nContent-Length: 0\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n";
    for (std::span<const char> rest(answer); !rest.empty();) {
      const ssize_t n = connection.write(rest.data(), rest.size());
      if (n < 0) return;
      rest = rest.subspan(static_cast<std::size_t>(n));
    }
  }

  // The connection of this thread's request, which httplib does not pass to handlers. A refused request is the connection's last,
  // because its body has not been read.
  static inline thread_local bool is_accepted_ = false;

  HttpLimits limits_;
  HttpHandlers handlers_;
};

}  // namespace

std::string HttpRequest::field(std::string_view name) const {
  const auto found = std::ranges::find_if(fields, [&](const auto& field) { return equal_names(field.first, name); });
  return found == fields.end() || count(name) > 1 ? std::string() : found->second;
}

std::size_t HttpRequest::count(std::string_view name) const {
  return static_cast<std::size_t>(
      std::ranges::count_if(fields, [&](const auto& field) { return equal_names(field.first, name); }));
}

struct HttpServer::Impl {
  explicit Impl(const HttpLimits& limits) : server(limits) {}
  Server server;
  int port = 0;
};

HttpServer::HttpServer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
HttpServer::HttpServer(HttpServer&&) noexcept = default;
HttpServer& HttpServer::operator=(HttpServer&&) noexcept = default;
HttpServer::~HttpServer() = default;

Result<HttpServer> HttpServer::listen(int port, const HttpLimits& limits) {
  auto impl = std::make_unique<Impl>(limits);
  constexpr const char* kLoopback = "127.0.0.1";
  impl->port = port;
  if (port == 0) {
    impl->port = impl->server.bind_to_any_port(kLoopback);
  } else if (!impl->server.bind_to_port(kLoopback, port)) {
    impl->port = -1;
  }
  if (impl->port < 0) {
    return make_error(Errc::open_failed, Error::kNone,
                      "cannot listen on this port; another program may use it: choose another --port");
  }
  return HttpServer(std::move(impl));
}

int HttpServer::port() const {
  return impl_->port;
}

void HttpServer::serve(const HttpHandlers& handlers) {
  impl_->server.use(handlers);
  impl_->server.listen_after_bind();
}

void HttpServer::stop() {
  impl_->server.stop();
}

}  // namespace rgs::view
