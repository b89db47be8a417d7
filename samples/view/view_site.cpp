// view_site.cpp - checks requests and answers them.
// SPDX-License-Identifier: Apache-2.0
#include "view_site.hpp"

#include <fmt/format.h>
#include <sys/random.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstddef>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <system_error>
#include <utility>

#include "byte_range.hpp"
#include "console.hpp"

namespace rgs::view {
namespace {

namespace fs = std::filesystem;

constexpr std::size_t kTokenBytes = 16;
constexpr std::size_t kMostPageFiles = 10'000;  // more than the page has, fewer than a home folder

// The page's policy: WebAssembly, workers and images from this server or from blobs, no inline styles, no inline scripts, no eval.
constexpr const char* kPolicy =
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; connect-src 'self' blob: "
    "data:; "
    "img-src 'self' blob: data:; style-src 'self'; font-src 'self'; manifest-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'";

using Fields = std::vector<std::pair<std::string, std::string>>;

Fields common_fields() {
  return {{"Content-Security-Policy", kPolicy},
          {"X-Content-Type-Options", "nosniff"},
          {"Referrer-Policy", "no-referrer"},
          {"Cross-Origin-Resource-Policy", "same-origin"},
          {"Cross-Origin-Opener-Policy", "same-origin"},
          {"Cache-Control", "no-store"}};
}

HttpAnswer with_common_fields(HttpAnswer answer) {
  for (auto& field : common_fields()) {
    if (std::ranges::find(answer.fields, field.first, &Fields::value_type::first) == answer.fields.end())
      answer.fields.push_back(std::move(field));
  }
  return answer;
}

HttpAnswer refusal(int status, std::string_view code, std::string_view message, Fields fields = {}) {
  return {.status = status, .fields = std::move(fields), .type = "application/json", .body = error_body(code, message)};
}

// In constant time, so that timing does not reveal a prefix.
bool same_token(std::string_view given, std::string_view token) {
  if (given.size() != token.size()) return false;
  unsigned different = 0;
  for (std::size_t i = 0; i < token.size(); ++i) different |= static_cast<unsigned char>(given[i] ^ token[i]);
  return different == 0;
}

// "assets/index-D4f_x2Ab.js": a name with a hash of the content, which can be cached for ever.
bool is_hashed_asset(std::string_view name) {
  constexpr std::size_t kHash = 8;
  if (!name.starts_with("assets/")) return false;
  const std::string_view stem = name.substr(0, name.rfind('.'));
  const std::size_t dash = stem.size() > kHash ? stem.size() - kHash - 1 : 0;
  const auto is_hash = [](char c) {
    return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '-' || c == '_';
  };
  return dash > 0 && stem[dash] == '-' && std::ranges::all_of(stem.substr(dash + 1), is_hash);
}

// Whether a Content-Length is a number within the limit.
bool is_size(std::string_view text, std::uint64_t limit) {
  std::uint64_t value = 0;
  for (const char c : text) {
    if (c < '0' || c > '9' || value > limit) return false;
    value = 10 * value + static_cast<std::uint64_t>(c - '0');
  }
  return !text.empty() && value <= limit;
}

const char* reason(int status) {
  switch (status) {
    case 400: return "the request is malformed";
    case 408: return "the request takes too long";
    case 413: return "the request's body is too large";
    case 431: return "the request's address and header are too long";
    case 500: return "rgs-view failed to answer; its terminal may say more";
    default: return "refused";
  }
}

}  // namespace

Result<std::string> random_token() {
  std::array<unsigned char, kTokenBytes> bytes{};
  if (::getrandom(bytes.data(), bytes.size(), 0) != static_cast<ssize_t>(bytes.size())) {
    return make_error(Errc::internal, Error::kNone, "the system has no random numbers", Error::kNone, Error::kNone,
                      errno);
  }
  std::string token;
  for (const unsigned char byte : bytes) token += fmt::format("{:02x}", byte);
  return token;
}

std::string error_body(std::string_view code, std::string_view message, std::uint64_t offset) {
  const nlohmann::ordered_json where =
      offset == Error::kNone ? nlohmann::ordered_json(nullptr) : nlohmann::ordered_json(offset);
  const nlohmann::ordered_json body{{"error", {{"code", code}, {"message", message}, {"offset", where}}}};
  return body.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
}

HttpAnswer error_answer(const Error& error) {
  constexpr int kRequest = 2, kMachine = 3, kFile = 4;
  int status = 500;
  switch (exit_code(error.code)) {
    case kRequest: status = 400; break;
    case kMachine:
      status = error.code == Errc::host_out_of_memory || error.code == Errc::device_out_of_memory ? 503 : 500;
      break;
    case kFile: status = 422; break;
    default: break;
  }
  std::string message = tool::describe(error);
  if (const char* hint = tool::hint(error); *hint != '\0') message += std::string("; ") + hint;
  return {
      .status = status, .type = "application/json", .body = error_body(errc_name(error.code), message, error.offset)};
}

Status ViewSite::add_file(const std::string& name, const std::string& path) {
  auto file = ServedFile::look(path);
  if (!file) return tl::unexpected(file.error());
  files_.insert_or_assign(name, *std::move(file));
  return {};
}

Status ViewSite::add_page(const std::string& folder) {
  std::error_code failed;
  for (fs::recursive_directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed)) {
    if (it->is_symlink(failed) || !it->is_regular_file(failed)) continue;
    if (files_.size() >= kMostPageFiles)
      return make_error(Errc::open_failed, Error::kNone, "has too many files to be the viewer's page");
    if (Status s = add_file(it->path().lexically_relative(folder).string(), it->path().string()); !s) return s;
  }
  if (failed)
    return make_error(Errc::open_failed, Error::kNone, "cannot be read", Error::kNone, Error::kNone, failed.value());
  if (!files_.contains("index.html")) return make_error(Errc::open_failed, Error::kNone, "has no index.html");
  files_.insert_or_assign("", files_.at("index.html"));
  return {};
}

std::string ViewSite::address() const {
  return fmt::format("http://127.0.0.1:{}/{}/", port_, token_);
}

HttpHandlers ViewSite::handlers() const {
  return {.refuse = [this](const HttpRequest& request) -> std::optional<HttpAnswer> {
            auto refusal = refuse(request);
            return refusal ? std::optional(with_common_fields(*std::move(refusal))) : std::nullopt;
          },
          .answer = [this](const HttpRequest& request) { return with_common_fields(answer(request)); },
          .fail =
              [](int status) {
                return with_common_fields(refusal(status, status >= 500 ? "internal" : "bad_request", reason(status)));
              }};
}

std::optional<std::string> ViewSite::name_of(const std::string& path) const {
  if (!path.starts_with('/')) return std::nullopt;
  const std::size_t end = std::min(path.find('/', 1), path.size());
  if (!same_token(std::string_view(path).substr(1, end - 1), token_)) return std::nullopt;
  return path.substr(std::min(end + 1, path.size()));
}

std::optional<HttpAnswer> ViewSite::refuse(const HttpRequest& request) const {
  // Against DNS rebinding: a page of another site sends its own host.
  const std::string host = request.field("Host");
  if (host != fmt::format("127.0.0.1:{}", port_) && host != fmt::format("localhost:{}", port_))
    return refusal(403, "other_host", "this server answers only requests to 127.0.0.1 and localhost");
  if (request.count("Origin") > 0 && request.field("Origin") != "http://" + host)
    return refusal(403, "other_origin", "this server answers only its own page");
  const auto name = name_of(request.path);
  if (!name) return refusal(403, "wrong_token", "this is not the address that rgs-view printed");
  if (request.count("Transfer-Encoding") > 0) return refusal(411, "no_length", "a body needs a Content-Length");

  const std::size_t n_lengths = request.count("Content-Length");
  const std::string length = request.field("Content-Length");
  if (n_lengths > 1) return refusal(400, "bad_request", "a request must have one Content-Length");
  if (actions_.contains(*name)) {
    if (request.method != "POST") return refusal(405, "bad_method", "this address takes POST", {{"Allow", "POST"}});
    if (n_lengths == 0) return refusal(411, "no_length", "a body needs a Content-Length");
    if (!is_size(length, HttpLimits{}.body_bytes)) return refusal(413, "too_large", "a body may have 64 KiB");
    const std::string type = request.field("Content-Type");
    if (!type.empty() && !type.starts_with("application/json") && !type.starts_with("text/plain"))
      return refusal(415, "bad_type", "the body must be application/json");
    if (request.count("Content-Encoding") > 0) return refusal(415, "bad_type", "the body must not be compressed");
    return std::nullopt;
  }
  if (request.method != "GET" && request.method != "HEAD")
    return refusal(405, "bad_method", "this address takes only GET and HEAD", {{"Allow", "GET, HEAD"}});
  if (n_lengths == 1 && length != "0") return refusal(413, "too_large", "a request for a file must not have a body");
  return std::nullopt;
}

HttpAnswer ViewSite::answer(const HttpRequest& request) const {
  const std::string name = name_of(request.path).value_or("");
  if (request.method == "POST") return actions_.at(name)(request.body);
  if (request.path == "/" + token_)
    return refusal(308, "moved", "with a slash at its end", {{"Location", "/" + token_ + "/"}});
  if (const auto text = texts_.find(name); text != texts_.end())
    return {.type = content_type(name), .body = text->second};
  if (const auto file = files_.find(name); file != files_.end()) return give(file->second, file->first, request);
  return refusal(404, "not_found", "there is no file of this name");
}

HttpAnswer ViewSite::give(const ServedFile& file, const std::string& name, const HttpRequest& request) const {
  const auto opened = file.open();
  if (!opened) {
    HttpAnswer failed = error_answer(opened.error());
    failed.status = opened.error().code == Errc::open_failed ? 410 : 409;
    return failed;
  }
  HttpAnswer answer{.fields = {{"Accept-Ranges", "bytes"}, {"ETag", file.tag()}},
                    .type = content_type(file.path()),
                    .file = *opened,
                    .count = file.size()};
  if (is_hashed_asset(name)) answer.fields.emplace_back("Cache-Control", "private, max-age=31536000, immutable");
  // A part of a newer file must not be joined to parts of an older one.
  const bool is_wanted = request.count("If-Range") == 0 || request.field("If-Range") == file.tag();
  if (request.method != "GET" || request.count("Range") != 1 || !is_wanted) return answer;
  const ByteRange range = parse_range(request.field("Range"), file.size());
  switch (range.kind) {
    case ByteRange::Kind::whole: break;
    case ByteRange::Kind::part:
      answer.status = 206;
      answer.first = range.first;
      answer.count = range.count;
      answer.fields.emplace_back(
          "Content-Range", fmt::format("bytes {}-{}/{}", range.first, range.first + range.count - 1, file.size()));
      break;
    case ByteRange::Kind::unsatisfiable:
      return refusal(416, "bad_range", "the file ends before this range",
                     {{"Content-Range", fmt::format("bytes */{}", file.size())}});
  }
  return answer;
}

}  // namespace rgs::view
