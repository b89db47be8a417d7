// byte_source.hpp - a file that is read in pieces: on a disk, behind a web server, or wherever a program keeps it.
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

/// Reads ranges of one file, which must stay as it is. All functions may be called by several threads at once; none may be at work
/// when the source is destroyed.
class ByteSource {
 public:
  virtual ~ByteSource() = default;
  /// Bytes of the file.
  virtual std::uint64_t size() const = 0;
  /// Fills `out` with the bytes from `offset` on; blocks until they are there. Errors: read_failed (also: the file is no longer the
  /// one that was opened, and what is asked for ends beyond it), cancelled, host_out_of_memory. Error::offset is the place in the file.
  /// After an error `out` holds anything.
  virtual Status read(std::uint64_t offset, std::span<std::byte> out) = 0;
  /// Reads at work end soon and all later ones at once, with Errc::cancelled.
  virtual void cancel() noexcept = 0;

  /// How reading pays. The same over the source's life.
  struct Traits {
    int reads_at_once = 4;               ///< threads that read side by side
    std::uint64_t most_bytes = 1 << 20;  ///< of one read, where there is a choice
    std::uint64_t gap_bytes = 32 << 10;  ///< between two reads, which cost less to read along than the second read
  };
  virtual Traits traits() const = 0;
};

/// A file on a disk, read in place: not mapped. Of a file that shrinks, grows or is written to, reads are errors (read_failed) from then on;
/// one that is removed or replaced under its name is read on as it was. Errors: open_failed (missing, unreadable, no regular file).
Result<std::unique_ptr<ByteSource>> open_file_source(const std::string& path);

/// How a web server is talked to.
struct UrlOptions {
  int reads_at_once = 6;        ///< requests in flight, 1 to 64; over one connection if the server has HTTP/2
  int retries = 6;              ///< of one read, in a row without a byte; after 0.25 s, then twice as long, up to 8 s
  double connect_seconds = 10;  ///< until a connection stands
  double stall_seconds = 20;    ///< for the head of an answer, and then without a byte: the request is made again
  int most_redirects = 5;       ///< of one request; never from https to http
  std::string certificates;     ///< PEM file of more to trust than the system's folder has; empty: the system's
  /// A request to stop ends the opening with Errc::cancelled; later it does what cancel() does.
  std::stop_token stop = {};
};

/// Whether a name is an address that open_url_source() reads: it begins with http:// or https://, in letters of either case.
bool is_url(const std::string& name);

/// A file behind an http(s) address, read by range requests. The first answer pins size, ETag and Last-Modified: a file that changes is
/// an error of the next read, never a mixture; without both fields only a change of size shows. The first 64 KiB are kept. Broken
/// connections, stalls and the statuses 408, 429, 500, 502, 503 and 504 are tried again. Certificates are always checked; proxies are
/// those of the environment (http_proxy, https_proxy, all_proxy, no_proxy). Blocks until the first answer is there. Errors: open_failed (no
/// connection, a certificate that is not trusted, a status of failure, which is in Error::found, a server without ranges (found: 200) for a file of more than
/// 64 KiB), unavailable (built without libcurl), cancelled (by UrlOptions::stop), bad_argument (no such address, an option out of its range). Error::found of read_failed
/// is the status too, where Error::expected is none.
Result<std::unique_ptr<ByteSource>> open_url_source(const std::string& url, const UrlOptions& options = {});

/// The one or the other, by is_url().
Result<std::unique_ptr<ByteSource>> open_source(const std::string& path_or_url, const UrlOptions& options = {});

}  // namespace rgs
