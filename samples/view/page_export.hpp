// page_export.hpp - the page with scenes, cameras and photographs in one file, which opens without a server.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/result.hpp"

namespace rgs::view {

/// Elements are inserted here.
inline constexpr std::string_view kInsertMark = "<!-- rgs-view:insert -->";

/// Escapes '<', '>' and '&' of `json` as \u003c and so on, so that nothing in it can end the script element.
std::string script_json(std::string_view json);

class PageExport {
 public:
  /// Errors: open_failed, read_failed; bad_syntax (kInsertMark does not occur once).
  static Result<PageExport> open(const std::string& page);

  /// Adds a base64 element and returns its address, "#rgs-file-0" and so on.
  std::string add(MappedFile file) { return add_part(std::move(file)); }
  std::string add(std::string text) { return add_part(std::move(text)); }
  /// view.json, with these addresses.
  void set_view(std::string_view json) { view_ = script_json(json); }

  std::uint64_t bytes() const;
  std::vector<const MappedFile*> inputs() const;
  /// Errors: write_failed.
  Status write(AtomicFile& out) const;

 private:
  using Part = std::variant<MappedFile, std::string>;
  std::string add_part(Part part);
  static std::string_view content(const Part& part);

  MappedFile page_;
  std::size_t mark_ = 0;
  std::string view_ = "{}";
  std::vector<Part> parts_;
};

}  // namespace rgs::view
