// http_answer.hpp - parses a web server's response to a range request and checks that it matches the request.
// SPDX-License-Identifier: Apache-2.0
//
// No server is trusted: bytes of another range or another file must never be taken for the requested ones.
// RFC 9110, chapters 8.8 (validators), 14 (ranges) and 15 (status).
#pragma once

#include <cstdint>
#include <optional>
#include <string_view>

#include "rgs/result.hpp"

namespace rgs::detail {

/// "bytes 0-65535/1000000"; "bytes */1000000" has neither first nor last.
struct ContentRange {
  bool satisfied = false;
  std::uint64_t first = 0, last = 0;  ///< inclusive
  std::optional<std::uint64_t> total;
};
/// Absent if malformed, if last < first, or if total <= last.
std::optional<ContentRange> parse_content_range(std::string_view text);

/// Seconds until a retry after so many failures in a row before, and after a Retry-After of the server's. `random`, of 0
/// to 1, spreads the retries of requests that failed together.
double retry_pause(int failures, double retry_after, double random);

/// The head of a response, line by line.
class HttpAnswer {
 public:
  /// Adds a line, with or without its end. A status line starts anew: of several responses to a request the last
  /// counts.
  void add_line(std::string_view line);
  /// Whether the line ends the head of the final response, not of one with a status 1xx.
  bool ends_head(std::string_view line) const;

  int status() const { return status_; }
  bool is_redirect() const;
  /// Whether the request may succeed later: 408, 429, 500, 502, 503, 504.
  bool is_transient() const;

 private:
  friend struct FilePin;
  int status_ = 0;
  std::optional<ContentRange> range_;
  std::optional<std::uint64_t> length_;           // of the body
  std::optional<std::uint64_t> etag_, modified_;  // hashes of their text
  bool encoded_ = false;                          // the server has compressed the body
  bool contradictory_ = false;                    // a field that occurs once has two values, or is malformed
};

/// Identifies the version of the file on the server.
struct FilePin {
  std::uint64_t size = 0;
  std::optional<std::uint64_t> etag, modified;

  /// From the response to a request for the first `n` bytes, which may be the whole file (200) if that is no longer.
  /// Errors: open_failed, with a failure status in Error::found.
  static Result<FilePin> of(const HttpAnswer& answer, std::uint64_t n);
  /// read_failed unless the response has bytes [begin, end) of this version or, if `whole`, is 200 with all of its
  /// bytes.
  Status check(const HttpAnswer& answer, std::uint64_t begin, std::uint64_t end, bool whole = false) const;
};

}  // namespace rgs::detail
