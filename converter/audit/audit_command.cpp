// audit_command.cpp - quotes shell words.
// SPDX-License-Identifier: Apache-2.0
#include "audit_command.hpp"

#include <algorithm>

#include "info_escape.hpp"

namespace rgs::audit {
namespace {

// Pages cut texts at 4,096 bytes; a cut command would be another one.
constexpr std::size_t kLongestCommand = 3000;

bool is_plain(char c) {
  return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
         std::string_view("_-./:,+@%").find(c) != std::string_view::npos;
}

// A path that programs do not take for an option.
std::string path_word(const std::string& path) {
  return shell_word(path.starts_with('-') ? "./" + path : path);
}

}  // namespace

std::string shell_word(std::string_view text) {
  if (tool::escape_untrusted(text, false, kLongestCommand) != text) return {};
  if (std::ranges::all_of(text, is_plain)) return std::string(text);
  std::string word = "'";
  for (const char c : text) word += c == '\'' ? std::string("'\"'\"'") : std::string(1, c);
  return word + "'";
}

std::string view_command(const Options& options) {
  const std::string source = path_word(options.source), asset = path_word(options.asset);
  if (source.empty() || asset.empty()) return {};
  std::string command = "rgs-view " + source + " " + asset;
  if (options.cameras.empty()) return command.size() <= kLongestCommand ? command : std::string();
  const std::string cameras = path_word(options.cameras);
  if (cameras.empty()) return {};
  const std::string photos = options.photos.empty() ? std::string() : path_word(options.photos);
  command += " --cameras " + cameras + (photos.empty() ? "" : " --photos " + photos);
  return command.size() <= kLongestCommand ? command : std::string();
}

std::string view_argument(std::string_view camera_name) {
  const std::string word = shell_word(camera_name);
  return word.empty() ? word : " --view=" + word;
}

}  // namespace rgs::audit
