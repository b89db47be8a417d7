// http_server.cpp - Boost.Asio waits and Boost.Beast parses: one thread reads and writes, others make answers and read files.
// SPDX-License-Identifier: Apache-2.0
#include "http_server.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/asio/thread_pool.hpp>
#include <boost/beast/core/string.hpp>
#include <boost/beast/http/empty_body.hpp>
#include <boost/beast/http/parser.hpp>
#include <boost/beast/http/status.hpp>
#include <boost/beast/http/verb.hpp>
#include <charconv>
#include <exception>
#include <limits>
#include <list>
#include <string_view>
#include <utility>

namespace rgs::view {
namespace {

namespace asio = boost::asio;
namespace http = boost::beast::http;
using asio::ip::tcp;
using boost::system::error_code;

// A browser opens six connections to a server, and two pages may be open.
constexpr std::size_t kThreads = 16;
constexpr std::size_t kMostWaiting = 128;  // connections without a whole request; of more the oldest are closed
constexpr std::size_t kReceiveBlock = 16 * 1024, kFileBlock = 256 * 1024;
// Bytes that are read from a refused client before the connection closes, so that it can read the answer.
constexpr std::size_t kLingerBytes = 1 << 20;
constexpr std::chrono::milliseconds kLingerTime{500};
constexpr std::chrono::milliseconds kAcceptAgain{10};  // when no more files can be open
constexpr std::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";

bool equal_names(std::string_view a, std::string_view b) {
  return boost::beast::iequals({a.data(), a.size()}, {b.data(), b.size()});
}

class Connection;

struct Server {
  HttpLimits limits;
  HttpHandlers handlers = {};
  std::list<Connection*> waiting = {};  // the oldest first
  asio::io_context io{1};
  tcp::acceptor acceptor{io};
  asio::steady_timer accept_again{io};
  asio::thread_pool pool{kThreads};

  error_code listen(int port);
  void accept();
  HttpAnswer answer(const HttpRequest& request) const;
};

// "%2f" becomes "/"; what is no such code stays.
std::string percent_decoded(std::string_view text) {
  std::string decoded;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const char* const at = text.data() + i;
    unsigned code = 0;
    if (*at == '%' && text.size() - i > 2 && std::from_chars(at + 1, at + 3, code, 16).ptr == at + 3) {
      decoded += static_cast<char>(code);
      i += 2;
    } else {
      decoded += *at;
    }
  }
  return decoded;
}

HttpRequest request_of(const http::request_header<>& from) {
  const std::string target(from.target());
  HttpRequest to{
      std::string(from.method_string()), percent_decoded(target.substr(0, target.find_first_of("?#"))), {}, {}};
  for (const auto& field : from) to.fields.emplace_back(field.name_string(), field.value());
  return to;
}

std::string head_of(const HttpAnswer& answer, bool is_last) {
  const std::string reason(http::obsolete_reason(static_cast<http::status>(answer.status)));
  std::string head = fmt::format("HTTP/1.1 {} {}\r\nContent-Length: {}\r\nConnection: {}\r\n", answer.status, reason,
                                 answer.count, is_last ? "close" : "keep-alive");
  if (!answer.type.empty()) head += fmt::format("Content-Type: {}\r\n", answer.type);
  for (const auto& [name, value] : answer.fields) head += fmt::format("{}: {}\r\n", name, value);
  return head + "\r\n";
}

// Answers one request after the other. What it waits for owns it: without that it closes.
class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(Server& server, tcp::socket socket) : server_(server), socket_(std::move(socket)), timer_(server.io) {}
  ~Connection() { leave_waiting(); }
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;

  void next_request() {
    request_ = {};
    begin(Stage::idle, server_.limits.idle_time);
    enter_waiting();
    buffer_.empty() ? receive() : received();
  }

 private:
  enum class Stage { idle, head, body, lingering };

  void begin(Stage stage, std::chrono::milliseconds time) {
    stage_ = stage;
    limit(time);
  }

  // The time of what is waited for next.
  void limit(std::chrono::milliseconds time) {
    timer_.expires_after(time);
    timer_.async_wait([weak = weak_from_this()](error_code) {
      const auto self = weak.lock();
      error_code ignored;
      if (self && self->is_late()) self->socket_.cancel(ignored);
    });
  }
  bool is_late() const { return timer_.expiry() <= asio::steady_timer::clock_type::now(); }

  void enter_waiting() {
    place_ = server_.waiting.insert(server_.waiting.end(), this);
    if (server_.waiting.size() <= kMostWaiting) return;
    Connection& oldest = *server_.waiting.front();
    oldest.leave_waiting();
    error_code ignored;
    oldest.socket_.close(ignored);
  }
  void leave_waiting() {
    if (place_) server_.waiting.erase(*place_);
    place_.reset();
  }

  void receive() {
    socket_.async_read_some(asio::buffer(block_), [self = shared_from_this()](error_code failed, std::size_t n) {
      self->buffer_.append(self->block_.data(), n);
      if (!failed && !self->is_late()) return self->received();
      if (self->stage_ == Stage::head || self->stage_ == Stage::body) self->refuse(self->is_late() ? 408 : 400);
    });
  }

  void received() {
    switch (stage_) {
      case Stage::idle: begin(Stage::head, server_.limits.request_time); [[fallthrough]];
      case Stage::head: return read_head();
      case Stage::body: return read_body();
      case Stage::lingering:
        lingered_ += std::exchange(buffer_, {}).size();
        if (lingered_ < kLingerBytes) receive();
    }
  }

  void read_head() {
    // Beast gets whole heads only: it does not limit those that come in parts.
    const std::size_t end = buffer_.find("\r\n\r\n"), most = server_.limits.head_bytes;
    if (end == buffer_.npos || end + 4 > most) return buffer_.size() >= most ? refuse(431) : receive();
    leave_waiting();
    http::request_parser<http::empty_body> parser;
    parser.header_limit(std::numeric_limits<std::uint32_t>::max());
    parser.body_limit(std::numeric_limits<std::uint64_t>::max());
    error_code failed;
    parser.put(asio::buffer(buffer_.data(), end + 4), failed);
    if (failed || parser.get().method() == http::verb::unknown) return refuse(400);
    request_ = request_of(parser.get());
    if (auto refusal = server_.handlers.refuse(request_)) return send(*std::move(refusal), true);
    const std::uint64_t body_bytes = parser.content_length().value_or(0);
    if (body_bytes > server_.limits.body_bytes || request_.count("Transfer-Encoding") > 0) return refuse(413);

    buffer_.erase(0, end + 4);
    body_bytes_ = static_cast<std::size_t>(body_bytes);
    is_last_ = !parser.keep_alive();
    begin(Stage::body, server_.limits.request_time);
    if (!equal_names(request_.field("Expect"), "100-continue")) return read_body();
    socket_.async_write_some(asio::buffer(kContinue), [self = shared_from_this()](error_code broken, std::size_t) {
      if (!broken) self->read_body();
    });
  }

  void read_body() {
    if (buffer_.size() < body_bytes_) return receive();
    request_.body = buffer_.substr(0, body_bytes_);
    buffer_.erase(0, body_bytes_);
    elsewhere([this] { return server_.answer(request_); },
              [this](HttpAnswer answer) { send(std::move(answer), is_last_); });
  }

  // Calls `work` on another thread, then `then` with its result on this one.
  template <class Work, class Then>
  void elsewhere(Work work, Then then) {
    asio::post(server_.pool, [self = shared_from_this(), work, then]() mutable {
      asio::io_context& io = self->server_.io;
      asio::post(io, [then, result = work(), self = std::move(self)]() mutable { then(std::move(result)); });
    });
  }

  // The end of such a request's body is unknown, so nothing may follow.
  void refuse(int status) { send(server_.handlers.fail(status), true); }

  void send(HttpAnswer answer, bool is_last) {
    leave_waiting();
    answer_ = std::move(answer);
    is_last_ = is_last;
    if (answer_.file == nullptr) answer_.count = answer_.body.size();
    out_ = head_of(answer_, is_last);
    if (request_.method != "HEAD") out_ += answer_.body;
    if (request_.method == "HEAD" || answer_.file == nullptr) answer_.count = 0;
    write(0);
  }

  void write(std::size_t sent) {
    limit(server_.limits.stall_time);
    socket_.async_write_some(asio::buffer(out_) + sent,
                             [self = shared_from_this(), sent](error_code failed, std::size_t n) {
                               if (failed) return;
                               if (sent + n < self->out_.size()) return self->write(sent + n);
                               if (self->answer_.count > 0) return self->read_block();
                               self->answer_ = {};
                               self->is_last_ ? self->linger() : self->next_request();
                             });
  }

  void read_block() {
    out_.resize(static_cast<std::size_t>(std::min<std::uint64_t>(kFileBlock, answer_.count)));
    elsewhere([this] { return answer_.file->read_at(answer_.first, out_).has_value(); },
              [this](bool is_read) {
                if (!is_read) return;
                answer_.first += out_.size();
                answer_.count -= out_.size();
                write(0);
              });
  }

  // No more is sent; what still comes is thrown away for a while.
  void linger() {
    error_code ignored;
    socket_.shutdown(tcp::socket::shutdown_send, ignored);
    begin(Stage::lingering, kLingerTime);
    enter_waiting();
    received();
  }

  Server& server_;
  tcp::socket socket_;
  asio::steady_timer timer_;
  std::optional<std::list<Connection*>::iterator> place_;  // among those that wait
  Stage stage_ = Stage::idle;
  std::array<char, kReceiveBlock> block_;
  std::string buffer_, out_;  // received and not yet read; to be sent
  HttpRequest request_;
  HttpAnswer answer_;  // of a file: its part that is not yet read
  std::size_t body_bytes_ = 0, lingered_ = 0;
  bool is_last_ = false;
};

error_code Server::listen(int port) {
  const tcp::endpoint loopback(asio::ip::address_v4::loopback(), static_cast<std::uint16_t>(port));
  error_code failed;
  acceptor.open(loopback.protocol(), failed);
  if (!failed) acceptor.set_option(tcp::acceptor::reuse_address(true), failed);
  if (!failed) acceptor.bind(loopback, failed);
  if (!failed) acceptor.listen(tcp::acceptor::max_listen_connections, failed);
  return failed;
}

void Server::accept() {
  acceptor.async_accept([this](error_code failed, tcp::socket socket) {
    if (failed) {
      accept_again.expires_after(kAcceptAgain);
      return accept_again.async_wait([this](error_code) { accept(); });
    }
    accept();
    socket.set_option(tcp::no_delay(true), failed);
    std::make_shared<Connection>(*this, std::move(socket))->next_request();
  });
}

HttpAnswer Server::answer(const HttpRequest& request) const {
  try {
    return handlers.answer(request);
  } catch (const std::exception&) {
    return handlers.fail(500);
  }
}

}  // namespace

std::string HttpRequest::field(std::string_view name) const {
  const auto found = std::ranges::find_if(fields, [&](const auto& field) { return equal_names(field.first, name); });
  return found == fields.end() || count(name) > 1 ? std::string() : found->second;
}

std::size_t HttpRequest::count(std::string_view name) const {
  return static_cast<std::size_t>(
      std::ranges::count_if(fields, [&](const auto& field) { return equal_names(field.first, name); }));
}

struct HttpServer::Impl : Server {};

HttpServer::HttpServer(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
HttpServer::HttpServer(HttpServer&&) noexcept = default;
HttpServer& HttpServer::operator=(HttpServer&&) noexcept = default;
HttpServer::~HttpServer() = default;

Result<HttpServer> HttpServer::listen(int port, const HttpLimits& limits) {
  auto impl = std::make_unique<Impl>();
  impl->limits = limits;
  if (impl->listen(port)) {
    return make_error(Errc::open_failed, Error::kNone,
                      "cannot listen on this port; another program may use it: choose another --port");
  }
  return HttpServer(std::move(impl));
}

int HttpServer::port() const {
  return impl_->acceptor.local_endpoint().port();
}

void HttpServer::serve(const HttpHandlers& handlers) {
  impl_->handlers = handlers;
  impl_->accept();
  while (!impl_->io.stopped()) {
    try {
      impl_->io.run();
    } catch (const std::exception&) {
      // No memory: the connection that met it has closed.
    }
  }
  impl_->pool.stop();
  impl_->pool.join();
}

void HttpServer::stop() {
  impl_->io.stop();
}

}  // namespace rgs::view
