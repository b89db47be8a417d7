// web_servers.hpp - servers on the loopback address for tests: a hostile one of our own, and nginx.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "await.hpp"
#include "checkout.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

namespace rgs::test {

/// These servers are reached without a proxy, whatever the environment says.
inline void use_no_proxy() {
  ::setenv("no_proxy", "127.0.0.1,localhost", 1);
}

/// A loopback port on which nobody listens, now or until the test allows it.
class ReservedPort {
 public:
  ReservedPort() : socket_(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    const int yes = 1;
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t size = sizeof address;
    // Another program of this user that requests the same may listen there.
    if (::setsockopt(socket_, SOL_SOCKET, SO_REUSEPORT, &yes, sizeof yes) != 0 ||
        ::bind(socket_, reinterpret_cast<sockaddr*>(&address), size) != 0 ||
        ::getsockname(socket_, reinterpret_cast<sockaddr*>(&address), &size) != 0)
      throw std::runtime_error("no free port");
    number_ = ntohs(address.sin_port);
  }
  ~ReservedPort() { ::close(socket_); }
  ReservedPort(const ReservedPort&) = delete;
  ReservedPort& operator=(const ReservedPort&) = delete;

  int number() const { return number_; }
  int socket() const { return socket_; }

 private:
  int socket_, number_ = 0;
};

/// hostile_server.py, which documents its addresses.
class HostileServer {
 public:
  HostileServer() : program_({RGS_PYTHON, "-B", source_dir() + "/tests/support/hostile_server.py"}) {
    use_no_proxy();
    await([&] { return log().find('\n') != std::string::npos || !program_.running(); });
    std::istringstream(log()).ignore(5) >> port_;
    if (port_ == 0) throw std::runtime_error("the hostile server does not start: " + program_.wait().err);
  }

  std::string host() const { return "127.0.0.1:" + std::to_string(port_); }
  /// path_and_options: "/truncated?from=2"
  std::string url(const std::string& path_and_options) const { return "http://" + host() + path_and_options; }

  /// Its output so far: a line for each request.
  std::string log() const { return program_.out(); }
  /// Number of requests so far whose log line contains `text`.
  int requests(const std::string& text = "") const {
    std::istringstream lines(log());
    int n = 0;
    for (std::string line; std::getline(lines, line);) {
      n += line.starts_with("GET ") && line.find(text) != std::string::npos ? 1 : 0;
    }
    return n;
  }

 private:
  Program program_;
  int port_ = 0;
};

/// nginx, serving the files of a folder.
class Nginx {
 public:
  static constexpr const char* kProgram = "/usr/sbin/nginx";
  static bool is_installed() { return ::access(kProgram, X_OK) == 0; }

  /// `ssl`: https, with HTTP/2 and its own certificate for 127.0.0.1. `directives` go into its server block.
  explicit Nginx(bool ssl, const std::string& directives = "") : ssl_(ssl) {
    use_no_proxy();
    std::filesystem::create_directory(folder_.file("files"));
    if (ssl) {
      const auto made = run_shell(
          "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=roofgs "
          "-addext subjectAltName=IP:127.0.0.1 -keyout " +
          folder_.file("key.pem") + " -out " + certificate());
      if (made.exit_code != 0) throw std::runtime_error("openssl: " + made.err);
    }
    write_configuration(directives);
    start();
  }

  /// Stops it and all connections.
  void end() { program_.reset(); }
  /// Restarts it at the same address.
  void start_again() { start(); }
  /// Connections stay open, and nothing arrives over them, until resume().
  void freeze() const { program_->send(SIGSTOP); }
  void resume() const { program_->send(SIGCONT); }

  int port() const { return port_.number(); }
  std::string file(const std::string& name) const { return folder_.file("files/" + name); }
  std::string certificate() const { return folder_.file("certificate.pem"); }
  std::string url(const std::string& name) const {
    return (ssl_ ? "https://127.0.0.1:" : "http://127.0.0.1:") + std::to_string(port_.number()) + "/" + name;
  }
  /// A line for each finished request: protocol, connection number, status, bytes of the body, range.
  std::vector<std::string> log() const {
    std::istringstream lines(text_of(folder_.file("access.log")));
    std::vector<std::string> all;
    for (std::string line; std::getline(lines, line);) all.push_back(line);
    return all;
  }

 private:
  static std::string text_of(const std::string& path) {
    std::ifstream in(path);
    return {std::istreambuf_iterator<char>(in), {}};
  }

  void start() {
    program_ = std::make_unique<Program>(std::vector<std::string>{
        kProgram, "-p", folder_.path().string(), "-c", folder_.file("nginx.conf"), "-e", folder_.file("error.log")});
    await([&] { return answers() || !program_->running(); });
    if (!program_->running()) throw std::runtime_error("nginx does not start: " + text_of(folder_.file("error.log")));
  }

  bool answers() const {
    const int fd = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    sockaddr_in a{};
    a.sin_family = AF_INET;
    a.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    a.sin_port = htons(static_cast<std::uint16_t>(port_.number()));
    const bool connected = ::connect(fd, reinterpret_cast<const sockaddr*>(&a), sizeof a) == 0;
    ::close(fd);
    return connected;
  }

  void write_configuration(const std::string& directives) const {
    const std::string at = folder_.path().string();
    std::ofstream out(folder_.file("nginx.conf"));
    out << "daemon off; master_process off; pid " << at << "/pid; error_log " << at << "/error.log;\n"
        << "events { worker_connections 64; }\nhttp {\n"
        << "log_format short '$server_protocol $connection $status $body_bytes_sent $http_range';\n"
        << "access_log " << at << "/access.log short;\n";
    for (const char* kind : {"client_body", "proxy", "fastcgi", "uwsgi", "scgi"}) {
      out << kind << "_temp_path " << at << "/" << kind << ";\n";
    }
    out << "server {\nlisten 127.0.0.1:" << port_.number() << (ssl_ ? " ssl http2" : "") << " reuseport;\n";
    if (ssl_) out << "ssl_certificate " << certificate() << "; ssl_certificate_key " << at << "/key.pem;\n";
    out << "root " << at << "/files;\n" << directives << "\n}\n}\n";
  }

  TemporaryFolder folder_;
  bool ssl_;
  ReservedPort port_;
  std::unique_ptr<Program> program_;
};

}  // namespace rgs::test
