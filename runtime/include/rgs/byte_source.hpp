// byte_source.hpp - a file that is read in ranges: from a disk, a web server, or wherever a program keeps it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <stop_token>
#include <string>

#include "rgs/result.hpp"

namespace RGS_API rgs {

/// Reads ranges of one file that does not change. Thread-safe; no call may be in progress when the source is destroyed.
class ByteSource {
 public:
  virtual ~ByteSource() = default;
  /// Bytes of the file.
  virtual std::uint64_t size() const = 0;
  /// Fills `out` with the bytes from `offset` on; blocks until it has them. Errors: read_failed (also: the file has
  /// changed, or the range ends beyond it), cancelled, host_out_of_memory. Error::offset is an offset in the file.
  /// After an error the content of `out` is unspecified.
  virtual Status read(std::uint64_t offset, std::span<std::byte> out) = 0;
  /// Ends reads in progress soon, and all later ones at once, with Errc::cancelled.
  virtual void cancel() noexcept = 0;
  /// Reads that have not ended so many seconds from now on fail (read_failed), and so do later ones; infinity: no limit.
  /// A source that never waits for long ignores it.
  virtual void set_limit([[maybe_unused]] double seconds) {}

  /// How to read efficiently. Constant.
  struct Traits {
    int reads_at_once = 4;               ///< concurrent reads
    std::uint64_t most_bytes = 1 << 20;  ///< of one read, where there is a choice
    std::uint64_t gap_bytes = 32 << 10;  ///< a smaller gap is cheaper to read than to skip
  };
  virtual Traits traits() const = 0;
};

/// A file on a disk, read, not mapped. If it shrinks, grows or is written to, reads fail (read_failed) from then on; if
/// it is removed or replaced under its name, reads continue on the old one. Errors: open_failed (missing, unreadable,
/// not a regular file).
Result<std::unique_ptr<ByteSource>> open_file_source(const std::string& path);

/// How to talk to a web server.
struct UrlOptions {
  int reads_at_once = 6;  ///< requests in flight, 1 to 64; over one connection with HTTP/2
  int retries = 6;        ///< of one read, in a row without a byte; pauses of 0.25 s, doubled up to 8 s
  /// To open, with all requests, redirects and retries; of a streamed scene until its coarsest page has come.
  double open_seconds = 60;
  double connect_seconds = 10;  ///< to establish a connection
  double stall_seconds = 20;    ///< without a byte, or without the response's head; then the request is repeated
  int most_redirects = 5;       ///< of one request; never from https to http
  std::string certificates;     ///< PEM file of additional trusted certificates; empty: the system's alone
  /// A stop request ends opening with Errc::cancelled; later it acts as cancel().
  std::stop_token stop = {};
};

/// Whether open_url_source() reads this name: it starts with http:// or https://, in either case.
bool is_url(const std::string& name);

/// A file behind an http(s) address, read by range requests. The first response pins size, ETag and Last-Modified: if
/// the file changes the next read fails, and bytes of two versions are never mixed; without both fields only a change
/// of size is noticed. The first 64 KiB are kept. Broken connections, stalls and the statuses 408, 429, 500, 502, 503
/// and 504 are retried. Certificates are always checked; proxies come from the environment (http_proxy, https_proxy,
/// all_proxy, no_proxy). Blocks until the first response. Errors: open_failed (no connection, an untrusted certificate,
/// a failure status, which is in Error::found, or a server without ranges (found: 200) for a file above 64 KiB),
/// unavailable (built without libcurl), cancelled (by UrlOptions::stop), bad_argument (a malformed address, an option
/// out of range). Error::found of read_failed is the status too if Error::expected is none.
Result<std::unique_ptr<ByteSource>> open_url_source(const std::string& url, const UrlOptions& options = {});

/// open_url_source() if is_url(), else open_file_source().
Result<std::unique_ptr<ByteSource>> open_source(const std::string& path_or_url, const UrlOptions& options = {});

}  // namespace rgs
