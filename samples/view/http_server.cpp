// http_server.cpp - cpp-httplib behind limits.
// SPDX-License-Identifier: Apache-2.0
#include "http_server.hpp"

#include <httplib.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <deque>
#include <mutex>
#include <span>
#include <string_view>
#include <thread>
#include <utility>
#include <vector>

namespace rgs::view {
namespace {

using Clock = std::chrono::steady_clock;

// A browser opens six connections to a server, and two pages may be open.
constexpr std::size_t kThreads = 16;
constexpr std::size_t kMostWaiting = 128;  // connections without a whole request; of more the oldest are closed
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
  enum class Head { incomplete, complete, malformed, too_large, too_slow };

  Connection(int socket, const HttpLimits& limits) : socket_(socket), limits_(limits) {}
  ~Connection() override { ::close(socket_); }
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;

  // What has come of the next head. Only whole ones go to httplib, so that it never waits for one.
  Head head() {
    if (is_too_slow_) return Head::too_slow;
    const std::size_t end = buffer_.find("\r\n\r\n");
    if (end == buffer_.npos || end + 4 > limits_.head_bytes)
      return buffer_.size() >= limits_.head_bytes ? Head::too_large : Head::incomplete;
    begin_ = 0;
    bytes_read_ = 0;
    head_bytes_ = end + 4;
    until_ = Clock::now() + limits_.request_time;
    if (!has_plain_lines()) return Head::malformed;
    hide_ranges();
    return Head::complete;
  }

  // While it waits for a request, or for the client to close. False: it has closed, or sent too much.
  void begin_wait() { until_ = Clock::now() + (has_begun() ? limits_.request_time : limits_.idle_time); }
  Clock::time_point waits_until() const { return until_; }
  bool take_what_has_come() {
    const bool had_begun = has_begun();
    if (!receive()) return false;
    if (lingers_) {
      linger_bytes_ += buffer_.size();
      buffer_.clear();
      return linger_bytes_ < kLingerBytes;
    }
    if (!had_begun && has_begun()) begin_wait();
    return true;
  }
  // The time is over. True: a request has begun, and is to be refused.
  bool ends_too_slow() { return is_too_slow_ = has_begun(); }

  // No more is sent; what still comes is thrown away for a while, so that the client can read the answer.
  void begin_linger() {
    ::shutdown(socket_, SHUT_WR);
    lingers_ = true;
    buffer_.clear();
    until_ = Clock::now() + kLingerTime;
  }
  bool lingers() const { return lingers_; }

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
      if (!wait_for(socket_, POLLIN, until_) || !receive() || buffer_.empty()) return -1;
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
  std::size_t count_request() { return ++n_requests_; }

 private:
  bool has_begun() const { return !buffer_.empty(); }

  // Never waits. False: the client has closed.
  bool receive() {
    std::array<char, 16384> bytes;
    for (;;) {
      const ssize_t n = ::recv(socket_, bytes.data(), bytes.size(), MSG_DONTWAIT);
      if (n < 0 && errno == EINTR) continue;
      if (n < 0 && errno == EAGAIN) return true;
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
  std::size_t begin_ = 0, head_bytes_ = 0, bytes_read_ = 0, n_requests_ = 0, linger_bytes_ = 0;
  bool is_too_slow_ = false, lingers_ = false;
  Clock::time_point until_{};
};

// Connections without a whole request. One thread watches them all, so that no number of them keeps others from being
// served.
class WaitingRoom {
 public:
  using Serve = std::function<void(std::unique_ptr<Connection>)>;

  // `serve` gets connections whose next request has come, or is to be refused.
  explicit WaitingRoom(Serve serve) : serve_(std::move(serve)), thread_([this] { work(); }) {}
  ~WaitingRoom() { ::close(wake_); }
  WaitingRoom(const WaitingRoom&) = delete;
  WaitingRoom& operator=(const WaitingRoom&) = delete;

  void add(std::unique_ptr<Connection> connection) {
    {
      const std::scoped_lock lock(mutex_);
      if (is_stopping_) return;
      arrived_.push_back(std::move(connection));
    }
    ::eventfd_write(wake_, 1);
  }
  void stop() {
    {
      const std::scoped_lock lock(mutex_);
      is_stopping_ = true;
    }
    ::eventfd_write(wake_, 1);
    thread_.join();
    arrived_.clear();
  }

 private:
  void work() {
    std::deque<std::unique_ptr<Connection>> waiting;  // the oldest first
    std::vector<pollfd> wanted;
    for (;;) {
      {
        const std::scoped_lock lock(mutex_);
        if (is_stopping_) return;
        std::ranges::move(arrived_, std::back_inserter(waiting));
        arrived_.clear();
      }
      wanted.assign(1, {wake_, POLLIN, 0});
      // Too many are looked at once, at what they have sent, before the oldest are closed.
      auto until = Clock::now() + std::chrono::hours(waiting.size() > kMostWaiting ? 0 : 1);
      for (const auto& connection : waiting) {
        wanted.push_back({connection->socket(), POLLIN, 0});
        until = std::min(until, connection->waits_until());
      }
      const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now()).count();
      ::poll(wanted.data(), wanted.size(), static_cast<int>(std::max<std::int64_t>(left, 0)));
      const auto now = Clock::now();
      eventfd_t count = 0;
      ::eventfd_read(wake_, &count);
      for (std::size_t i = 0; i < waiting.size(); ++i) look(waiting[i], wanted[i + 1].revents != 0, now);
      std::erase(waiting, nullptr);
      while (waiting.size() > kMostWaiting) waiting.pop_front();
    }
  }

  // Keeps the connection, closes it or gives it away.
  void look(std::unique_ptr<Connection>& connection, bool has_come, Clock::time_point now) const {
    if (has_come && !connection->take_what_has_come()) return connection.reset();
    if (!connection->lingers() && connection->head() != Connection::Head::incomplete)
      return serve_(std::move(connection));
    if (connection->waits_until() > now) return;
    if (connection->lingers() || !connection->ends_too_slow()) return connection.reset();
    serve_(std::move(connection));
  }

  const int wake_ = ::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  Serve serve_;
  std::mutex mutex_;  // of these two
  std::vector<std::unique_ptr<Connection>> arrived_;
  bool is_stopping_ = false;
  std::thread thread_;
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
    new_task_queue = [this] { return new Threads(*this); };
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
    ::listen(svr_sock_, SOMAXCONN);  // httplib's 5 would make clients of a busy server try again after a second
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
  // httplib's thread that accepts only brings connections to the waiting room, from where others serve them.
  class Threads final : public httplib::TaskQueue {
   public:
    explicit Threads(Server& server) {
      server.room_.emplace([this, &server](std::unique_ptr<Connection> connection) {
        pool_.enqueue([&server, shared = std::make_shared<std::unique_ptr<Connection>>(std::move(connection))] {
          server.serve(std::move(*shared));
        });
      });
      room_ = &*server.room_;
    }
    void enqueue(std::function<void()> accepted) override { accepted(); }
    void shutdown() override {
      room_->stop();
      pool_.shutdown();
    }

   private:
    httplib::ThreadPool pool_{kThreads};
    WaitingRoom* room_;
  };

  bool process_and_close_socket(int socket) override {
    const int yes = 1;
    ::setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    auto connection = std::make_unique<Connection>(socket, limits_);
    connection->begin_wait();
    room_->add(std::move(connection));
    return true;
  }

  void serve(std::unique_ptr<Connection> connection) {
    if (answer(*connection)) {
      connection->begin_wait();
    } else {
      connection->begin_linger();
    }
    room_->add(std::move(connection));
  }

  // Whether another request may follow.
  bool answer(Connection& connection) {
    for (;;) {
      switch (connection.head()) {
        case Connection::Head::complete: break;
        case Connection::Head::incomplete: return true;
        case Connection::Head::malformed: return refuse(connection, 400, "Bad Request");
        case Connection::Head::too_large: return refuse(connection, 431, "Request Header Fields Too Large");
        case Connection::Head::too_slow: return refuse(connection, 408, "Request Timeout");
      }
      bool is_last = connection.count_request() == kRequestsOfConnection || svr_sock_ < 0;
      std::size_t body_bytes = 0;
      const auto look = [&](httplib::Request& request) {
        body_bytes = stated_body(request);
        request.headers.erase("Accept-Encoding");  // compression takes longer than sending
      };
      is_accepted_ = false;
      if (!process_request(connection, is_last, is_last, look) || is_last || !is_accepted_ ||
          !connection.is_consumed(body_bytes))
        return false;
      connection.forget_request();
    }
  }

  static bool refuse(Connection& connection, int status, std::string_view reason) {
    const std::string answer = "HTTP/1.1 " + std::to_string(status) + ' ' + std::string(reason) +
                               "\r\nContent-Length: 0\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n";
    for (std::span<const char> rest(answer); !rest.empty();) {
      const ssize_t n = connection.write(rest.data(), rest.size());
      if (n < 0) break;
      rest = rest.subspan(static_cast<std::size_t>(n));
    }
    return false;
  }

  // The connection of this thread's request, which httplib does not pass to handlers. A refused request is the connection's last,
  // because its body has not been read.
  static inline thread_local bool is_accepted_ = false;

  HttpLimits limits_;
  HttpHandlers handlers_;
  std::optional<WaitingRoom> room_;
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
