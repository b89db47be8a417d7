// byte_source.hpp - a file that is read in pieces: on a disk, behind a web server, or wherever a program keeps it.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "rgs/result.hpp"

namespace RGS_API rgs {

/// Reads ranges of one file, which must stay as it is. All functions may be called by several threads at once.
class ByteSource {
 public:
  virtual ~ByteSource() = default;
  /// Bytes of the file.
  virtual std::uint64_t size() const = 0;
  /// Fills `out` with the bytes from `offset` on; blocks until they are there. Errors: read_failed (also: the file is no longer the
  /// one that was opened, and what is asked for ends beyond it), cancelled, host_out_of_memory. Error::offset is the place in the file.
  virtual Status read(std::uint64_t offset, std::span<std::byte> out) = 0;
  /// Reads at work end soon and all later ones at once, with Errc::cancelled.
  virtual void cancel() noexcept = 0;

  /// How reading pays.
  struct Traits {
    int reads_at_once = 4;               ///< threads that read side by side
    std::uint64_t most_bytes = 1 << 20;  ///< of one read, where there is a choice
    std::uint64_t gap_bytes = 32 << 10;  ///< that cost less to read along than a read of its own
  };
  virtual Traits traits() const = 0;
};

/// A file on a disk. Errors: open_failed.
Result<std::unique_ptr<ByteSource>> open_file_source(const std::string& path);

/// How a web server is talked to.
struct UrlOptions {
  int reads_at_once = 6;        ///< requests in flight, over one connection where the server speaks HTTP/2
  int retries = 6;              ///< of one read, with pauses that double from a quarter of a second up to 8 s
  double connect_seconds = 10;  ///< until a connection stands
  double stall_seconds = 20;    ///< without a byte, after which a request is made again
  int most_redirects = 5;       ///< only from https to https, or from http
  std::string certificates;     ///< file of certificates to trust; empty: those of the system
};

/// Whether a name is an address that open_url_source() reads: it begins with http:// or https://.
bool is_url(const std::string& name);

/// A file behind an http(s) address, read by range requests. The first answer pins ETag, or Last-Modified, and the size: a file that changes is
/// an error of the next read, never a mixture. Certificates are always checked. Errors: open_failed (no answer, a status that is not
/// 200 or 206 (Error::found), a server without ranges), unavailable (built without libcurl), bad_argument (no such address).
Result<std::unique_ptr<ByteSource>> open_url_source(const std::string& url, const UrlOptions& options = {});

/// Either, by is_url().
Result<std::unique_ptr<ByteSource>> open_source(const std::string& path_or_url, const UrlOptions& options = {});

}  // namespace rgs
