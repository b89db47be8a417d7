// view_site.hpp - what rgs-view gives out, and to whom: the page, the named files, cameras, photographs and frames.
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

/// {"error": {code, message, offset}} for a request that went wrong; offset is null where there is none.
std::string error_body(std::string_view code, std::string_view message, std::uint64_t offset = Error::kNone);
/// The same of what a file or the renderer reports, with the status that says whose fault it is.
HttpAnswer error_answer(const Error& error);

/// Names below the token, as they are after decoding, and what stands under them. Nothing else is given out: a name is looked up and never
/// becomes a path.
class ViewSite {
 public:
  ViewSite(std::string token, int port) : token_(std::move(token)), port_(port) {}

  /// Errors: those of ServedFile::look().
  Status add_file(const std::string& name, const std::string& path);
  void add_json(const std::string& name, std::string text) { texts_[name] = std::move(text); }
  /// All files of the built page's folder, below it too, but for links; index.html stands for the folder. Errors: open_failed, also
  /// without an index.html.
  Status add_page(const std::string& folder);
  /// Answers POST of this name from the body.
  void add_action(const std::string& name, std::function<HttpAnswer(const std::string&)> action) {
    actions_[name] = std::move(action);
  }

  std::string address() const;
  HttpHandlers handlers() const;

 private:
  std::optional<HttpAnswer> refuse(const HttpRequest& request) const;
  HttpAnswer answer(const HttpRequest& request) const;
  HttpAnswer give(const ServedFile& file, const std::string& name, const HttpRequest& request) const;
  // The name that a path has below the token; nothing if the token is another.
  std::optional<std::string> name_of(const std::string& path) const;

  std::string token_;
  int port_;
  std::map<std::string, ServedFile> files_;
  std::map<std::string, std::string> texts_;
  std::map<std::string, std::function<HttpAnswer(const std::string&)>> actions_;
};

}  // namespace rgs::view
