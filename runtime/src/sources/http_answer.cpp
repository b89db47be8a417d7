// http_answer.cpp - SPDX-License-Identifier: Apache-2.0
#include "sources/http_answer.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <span>

#include "rgs/checksum.hpp"

namespace rgs::detail {
namespace {

char lower(char c) {
  return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
}

bool equal_without_case(std::string_view a, std::string_view b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](char x, char y) { return lower(x) == lower(y); });
}

std::string_view trimmed(std::string_view text) {
  const auto blank = [](char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; };
  while (!text.empty() && blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && blank(text.back())) text.remove_suffix(1);
  return text;
}

std::optional<std::uint64_t> parse_number(std::string_view text) {
  std::uint64_t value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || error != std::errc() || end != text.data() + text.size()) return std::nullopt;
  return value;
}

std::uint64_t hash(std::string_view text) {
  return xxh3(std::as_bytes(std::span(text)));
}

// Keeps the first of two values; the second must equal it.
template <class T, class Same>
void set_once(std::optional<T>& field, const std::optional<T>& value, bool& contrary, const Same& same) {
  if (!value || (field && !same(*field, *value))) contrary = true;
  if (!field) field = value;
}
void set_once(std::optional<std::uint64_t>& field, const std::optional<std::uint64_t>& value, bool& contrary) {
  set_once(field, value, contrary, [](std::uint64_t a, std::uint64_t b) { return a == b; });
}

tl::unexpected<Error> status_error(Errc code, std::uint64_t offset, int status) {
  const char* what = "the server answers with an error";
  switch (status) {
    case 200: what = "the server does not support range requests, which reading needs; download the file"; break;
    case 401:
    case 403:
    case 407: what = "the server denies access to the file"; break;
    case 404:
    case 410: what = "the server has no such file"; break;
    case 416: what = "the file on the server ends before the requested range"; break;
    case 429: what = "the server has received too many requests"; break;
    default: break;
  }
  return make_error(code, offset, what, Error::kNone, static_cast<std::uint64_t>(status));
}

constexpr const char* kEncoded = "the server sends the file compressed, against our request; download the file";
constexpr const char* kContradiction = "the server's answer contradicts itself";
constexpr const char* kOtherRange = "the server sends another range than was requested";
constexpr const char* kChanged = "the file on the server has changed; open it again";

}  // namespace

std::optional<ContentRange> parse_content_range(std::string_view text) {
  constexpr std::string_view kUnit = "bytes ";
  text = trimmed(text);
  if (!equal_without_case(text.substr(0, kUnit.size()), kUnit)) return std::nullopt;
  text = trimmed(text.substr(kUnit.size()));
  const std::size_t slash = text.find('/');
  if (slash == std::string_view::npos) return std::nullopt;
  const std::string_view range = text.substr(0, slash), total = text.substr(slash + 1);
  ContentRange found;
  if (total != "*") {
    found.total = parse_number(total);
    if (!found.total) return std::nullopt;
  }
  if (range == "*") return found;
  const std::size_t dash = range.find('-');
  if (dash == std::string_view::npos) return std::nullopt;
  const auto first = parse_number(range.substr(0, dash)), last = parse_number(range.substr(dash + 1));
  if (!first || !last || *last < *first || (found.total && *found.total <= *last)) return std::nullopt;
  found.satisfied = true;
  found.first = *first;
  found.last = *last;
  return found;
}

double retry_pause(int failures, double retry_after, double random) {
  constexpr double kFirstPause = 0.25, kMostPause = 8, kMostRetryAfter = 30;
  const double own = std::min(kMostPause, std::ldexp(kFirstPause, std::min(failures, 30))) * (0.75 + 0.25 * random);
  return std::max(own, std::min(retry_after, kMostRetryAfter));
}

void HttpAnswer::add_line(std::string_view line) {
  if (line.substr(0, 5) == "HTTP/") {
    *this = HttpAnswer();
    const std::size_t space = line.find(' ');
    const auto status = space == std::string_view::npos ? std::nullopt : parse_number(line.substr(space + 1, 3));
    status_ = status && *status >= 100 ? static_cast<int>(*status) : 0;
    return;
  }
  const std::size_t colon = line.find(':');
  if (colon == std::string_view::npos) return;
  const std::string_view name = line.substr(0, colon);
  std::string_view value = trimmed(line.substr(colon + 1));
  if (equal_without_case(name, "content-range")) {
    set_once(range_, parse_content_range(value), contradictory_, [](const ContentRange& a, const ContentRange& b) {
      return a.satisfied == b.satisfied && a.first == b.first && a.last == b.last && a.total == b.total;
    });
  } else if (equal_without_case(name, "content-length")) {
    set_once(length_, parse_number(value), contradictory_);
  } else if (equal_without_case(name, "content-encoding")) {
    encoded_ |= !value.empty() && !equal_without_case(value, "identity");
  } else if (equal_without_case(name, "etag")) {
    // Servers that compress may weaken the tag; it still names the same file.
    if (value.substr(0, 2) == "W/") value.remove_prefix(2);
    set_once(etag_, std::optional(hash(value)), contradictory_);
  } else if (equal_without_case(name, "last-modified")) {
    set_once(modified_, std::optional(hash(value)), contradictory_);
  }
}

bool HttpAnswer::ends_head(std::string_view line) const {
  return trimmed(line).empty() && status_ >= 200;
}

bool HttpAnswer::is_redirect() const {
  return status_ == 301 || status_ == 302 || status_ == 303 || status_ == 307 || status_ == 308;
}

bool HttpAnswer::is_transient() const {
  return status_ == 408 || status_ == 429 || status_ == 500 || (status_ >= 502 && status_ <= 504);
}

Result<FilePin> FilePin::of(const HttpAnswer& answer, std::uint64_t n) {
  const auto failed = [](const char* what) { return make_error(Errc::open_failed, Error::kNone, what); };
  FilePin pin{0, answer.etag_, answer.modified_};
  // 416 tells of a file's first bytes only that the file is empty.
  if (answer.status_ == 416 && answer.range_ && answer.range_->total == std::uint64_t{0}) return pin;
  if (answer.status_ != 200 && answer.status_ != 206)
    return status_error(Errc::open_failed, Error::kNone, answer.status_);
  if (answer.encoded_) return failed(kEncoded);
  if (answer.contradictory_) return failed(kContradiction);
  if (answer.status_ == 200) {
    // A length is required: a body that ends with the connection may have been cut off.
    if (!answer.length_ || *answer.length_ > n) return status_error(Errc::open_failed, Error::kNone, 200);
    pin.size = *answer.length_;
    return pin;
  }
  if (!answer.range_ || !answer.range_->satisfied || !answer.range_->total) return failed(kOtherRange);
  pin.size = *answer.range_->total;
  if (pin.size > static_cast<std::uint64_t>(INT64_MAX)) return failed(kOtherRange);
  const std::uint64_t there = std::min(n, pin.size);
  if (answer.range_->first != 0 || answer.range_->last != there - 1) return failed(kOtherRange);
  if (answer.length_ && *answer.length_ != there) return failed(kContradiction);
  return pin;
}

Status FilePin::check(const HttpAnswer& answer, std::uint64_t begin, std::uint64_t end, bool whole) const {
  const auto failed = [&](const char* what) { return make_error(Errc::read_failed, begin, what); };
  const bool success = answer.status_ == 200 || answer.status_ == 206;
  if (!success && answer.status_ != 416) return status_error(Errc::read_failed, begin, answer.status_);
  if (answer.range_ && answer.range_->total && *answer.range_->total != size) {
    return make_error(Errc::read_failed, begin, kChanged, size, *answer.range_->total);
  }
  if (!success) return status_error(Errc::read_failed, begin, answer.status_);
  if (answer.contradictory_) return failed(kContradiction);
  // Fields that both responses have must be equal; at least one of the pinned fields must be there.
  const bool tags = etag && answer.etag_, times = modified && answer.modified_;
  if ((tags && *etag != *answer.etag_) || (times && *modified != *answer.modified_)) return failed(kChanged);
  if ((etag || modified) && !tags && !times) return failed("the server no longer states the version of the file");
  if (answer.status_ == 200 && !whole) return status_error(Errc::read_failed, begin, 200);
  if (answer.encoded_) return failed(kEncoded);
  if (answer.status_ == 200) {
    if (!answer.length_) return status_error(Errc::read_failed, begin, 200);
    if (*answer.length_ != size) return make_error(Errc::read_failed, begin, kChanged, size, *answer.length_);
    return {};
  }
  if (!answer.range_ || !answer.range_->satisfied || !answer.range_->total || answer.range_->first != begin ||
      answer.range_->last != end - 1) {
    return failed(kOtherRange);
  }
  if (answer.length_ && *answer.length_ != end - begin) return failed(kContradiction);
  return {};
}

}  // namespace rgs::detail
