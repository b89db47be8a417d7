// url_time.hpp - a clock that the test moves, and a web server that the test answers by hand.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <string_view>

#include "await.hpp"
#include "sources/url_clock.hpp"
#include "web_servers.hpp"

namespace rgs::test {

/// Stands still between two calls of advance(), or advances by so much with each turn of the source, so that nobody
/// waits for its pauses. Outlives its source.
class UrlTime {
 public:
  explicit UrlTime(std::chrono::nanoseconds a_turn = {}) : a_turn_(a_turn) {}
  detail::UrlClock clock() {
    return {[this] {
              const std::scoped_lock lock(mutex_);
              ++n_turns_;
              turned_.notify_all();
              return now_ += a_turn_;
            },
            std::chrono::milliseconds(1)};
  }
  /// Advances the clock, or not (0), and returns after a whole turn of the source at that time, which has then read
  /// everything that had arrived.
  void advance(double seconds) {
    std::unique_lock lock(mutex_);
    now_ += std::chrono::nanoseconds(std::llround(seconds * 1e9));
    turned_.wait(lock, [this, before = n_turns_] { return n_turns_ >= before + 2; });
  }
  /// Advances the clock and returns at once: for a source that then ends.
  void advance_last(double seconds) {
    const std::scoped_lock lock(mutex_);
    now_ += std::chrono::nanoseconds(std::llround(seconds * 1e9));
  }

 private:
  std::mutex mutex_;
  std::condition_variable turned_;
  const std::chrono::nanoseconds a_turn_;
  std::chrono::steady_clock::time_point now_{std::chrono::hours(1)};
  std::uint64_t n_turns_ = 0;
};

/// A connection on the server's side.
class Peer {
 public:
  explicit Peer(int fd) : fd_(fd) {}
  ~Peer() { ::close(fd_); }
  Peer(const Peer&) = delete;
  Peer& operator=(const Peer&) = delete;

  /// Whether the next request is for this range.
  bool asks(const std::string& range) {
    while (received_.find("\r\n\r\n") == received_.npos) {
      if (!receive()) return false;
    }
    const std::size_t end = received_.find("\r\n\r\n") + 4;
    const std::string head = received_.substr(0, end);
    received_.erase(0, end);
    return head.find("\r\nRange: " + range + "\r\n") != head.npos;
  }
  /// Whether the client closes the connection instead of requesting more.
  bool is_left() { return !receive(); }
  /// Returns when all of it has arrived at the client's socket.
  void send(std::string_view text) const {
    while (!text.empty()) {
      const ssize_t n = ::send(fd_, text.data(), text.size(), MSG_NOSIGNAL);
      if (n <= 0) return;
      text.remove_prefix(static_cast<std::size_t>(n));
    }
    await([this] {
      int n_left = 0;
      return ::ioctl(fd_, TIOCOUTQ, &n_left) != 0 || n_left == 0;
    });
  }

 private:
  bool receive() {
    std::array<char, 4096> bytes;
    const ssize_t n = ::recv(fd_, bytes.data(), bytes.size(), 0);
    if (n <= 0) return false;
    received_.append(bytes.data(), static_cast<std::size_t>(n));
    return true;
  }

  int fd_;
  std::string received_;
};

class HandServer {
 public:
  HandServer() {
    use_no_proxy();
    if (::listen(port_.socket(), 8) != 0) throw std::runtime_error("cannot listen");
  }
  std::string url() const { return "http://127.0.0.1:" + std::to_string(port_.number()) + "/"; }
  /// Whether a connection waits to be accepted.
  bool has_connection() const {
    pollfd wanted{port_.socket(), POLLIN, 0};
    return ::poll(&wanted, 1, 0) > 0;
  }
  /// Waits for a connection.
  std::unique_ptr<Peer> accept() const {
    const int fd = ::accept4(port_.socket(), nullptr, nullptr, SOCK_CLOEXEC);
    if (fd < 0) throw std::runtime_error("no connection comes");
    return std::make_unique<Peer>(fd);
  }

 private:
  ReservedPort port_;
};

}  // namespace rgs::test
