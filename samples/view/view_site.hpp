// view_site.hpp - serves the page, scenes, cameras, photographs and frames to whoever has the token.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <string_view>

#include "http_server.hpp"
#include "rgs/result.hpp"
#include "served_file.hpp"

namespace rgs::view {

/// 32 hexadecimal digits from the system's random numbers. Error: internal.
Result<std::string> random_token();

/// {"error": {code, message, offset}}; offset may be null.
std::string error_body(std::string_view code, std::string_view message, std::uint64_t offset = Error::kNone);
/// The same for an error of a file or the renderer, with an HTTP status.
HttpAnswer error_answer(const Error& error);

/// Maps names below the token to files and answers. Nothing else is served: names are looked up and never become paths.
class ViewSite {
 public:
  ViewSite(std::string token, int port) : token_(std::move(token)), port_(port) {}

  /// Errors: those of ServedFile::look().
  Status add_file(const std::string& name, const std::string& path);
  void add_json(const std::string& name, std::string text) { texts_[name] = std::move(text); }
  /// Adds all files of the built page's folder, without links; index.html answers for the folder. Errors: open_failed (also without an
  /// index.html).
  Status add_page(const std::string& folder);
  /// Answers POST requests of this name, from the body.
  void add_action(const std::string& name, std::function<HttpAnswer(const std::string&)> action) {
    actions_[name] = std::move(action);
  }

  std::string address() const;
  HttpHandlers handlers() const;

 private:
  std::optional<HttpAnswer> refuse(const HttpRequest& request) const;
  HttpAnswer answer(const HttpRequest& request) const;
  HttpAnswer give(const ServedFile& file, const std::string& name, const HttpRequest& request) const;
  // The part of a path behind the token; nothing if the token is wrong.
  std::optional<std::string> name_of(const std::string& path) const;

  std::string token_;
  int port_;
  std::map<std::string, ServedFile> files_;
  std::map<std::string, std::string> texts_;
  std::map<std::string, std::function<HttpAnswer(const std::string&)>> actions_;
};

}  // namespace rgs::view
