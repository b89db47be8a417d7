// open_source.cpp - tells paths from addresses. On its own, so that a program that opens paths alone does not link
// libcurl.
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <string_view>

#include "rgs/byte_source.hpp"

namespace rgs {

bool is_url(const std::string& name) {
  const auto begins_with = [&](std::string_view scheme) {
    return name.size() >= scheme.size() && std::equal(scheme.begin(), scheme.end(), name.begin(), [](char s, char c) {
             return s == (c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c);
           });
  };
  return begins_with("http://") || begins_with("https://");
}

Result<std::unique_ptr<ByteSource>> open_source(const std::string& path_or_url, const UrlOptions& options) {
  return is_url(path_or_url) ? open_url_source(path_or_url, options) : open_file_source(path_or_url);
}

}  // namespace rgs
