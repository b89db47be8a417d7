// audit_encoding.cpp - percent-encoding (RFC 3986).
// SPDX-License-Identifier: Apache-2.0
#include "audit_encoding.hpp"

#include <fmt/format.h>

#include <iterator>

namespace rgs::audit {
namespace {

bool is_unreserved(char c) {
  return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') ||
         std::string_view("-._~").find(c) != std::string_view::npos;
}

}  // namespace

std::string link_to_file(std::string_view name) {
  std::string out = "./";
  for (const char c : name) {
    if (is_unreserved(c)) {
      out += c;
    } else {
      fmt::format_to(std::back_inserter(out), "%{:02X}", static_cast<unsigned char>(c));
    }
  }
  return out;
}

}  // namespace rgs::audit
