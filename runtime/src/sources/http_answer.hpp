// http_answer.hpp - what a web server's answer to a range request says, and whether it is an answer to what was asked.
// SPDX-License-Identifier: Apache-2.0
//
// No server is trusted: a range of other bytes, or of another file, must never pass for the one that was asked for.
// RFC 9110, chapters 8.8 (validators), 14 (ranges) and 15 (status).
#pragma once

#include <cstdint>
#include <optional>
#include <string_view>

#include "rgs/result.hpp"

namespace rgs::detail {

/// "bytes 0-65535/1000000"; "bytes */1000000" has no first and last.
struct ContentRange {
  bool satisfied = false;
  std::uint64_t first = 0, last = 0;  ///< last is part of the range
  std::optional<std::uint64_t> total;
};
/// Absent if `text` is no such range. last < first, or total <= last, is none.
std::optional<ContentRange> parse_content_range(std::string_view text);

/// The head of an answer, line by line.
class HttpAnswer {
 public:
  /// One line, with or without its end. A status line begins anew: only the last answer counts of those to one request.
  void add_line(std::string_view line);
  /// Whether the line ends the head of an answer that is the last: not one of 1xx.
  bool ends_head(std::string_view line) const;

  int status() const { return status_; }
  bool is_redirect() const;
  /// Whether the same request may succeed later: 408, 429, 500, 502, 503, 504.
  bool is_transient() const;

 private:
  friend struct FilePin;
  int status_ = 0;
  std::optional<ContentRange> range_;
  std::optional<std::uint64_t> length_;           // of the body
  std::optional<std::uint64_t> etag_, modified_;  // hashes of their text
  bool encoded_ = false;                          // the body is not the file's bytes but packed by the server
  bool contrary_ = false;  // fields of a kind that is there once contradict each other, or cannot be read
};

/// What tells the file on the server from another one.
struct FilePin {
  std::uint64_t size = 0;
  std::optional<std::uint64_t> etag, modified;

  /// From the answer to a request for the first `n` bytes. It may be of the whole file (200) if it has no more than these.
  /// Errors: open_failed, with the status in Error::found if it is not that of success.
  static Result<FilePin> of(const HttpAnswer& answer, std::uint64_t n);
  /// read_failed unless the answer has the bytes [begin, end) of this very file; `whole`: or, as 200, all of its bytes.
  Status check(const HttpAnswer& answer, std::uint64_t begin, std::uint64_t end, bool whole = false) const;
};

}  // namespace rgs::detail
