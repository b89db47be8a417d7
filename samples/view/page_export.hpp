// page_export.hpp - the page with all that it shows in one file, which opens from a disk without a server.
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

/// Where the single-file page takes what is added to it.
inline constexpr std::string_view kInsertMark = "<!-- rgs-view:insert -->";

/// `json` for the inside of a script element, which nothing in it can end: '<', '>' and '&' as \u003c and so on. They stand in its texts alone.
std::string script_json(std::string_view json);

class PageExport {
 public:
  /// Errors: open_failed, read_failed; bad_syntax (kInsertMark is not there once).
  static Result<PageExport> open(const std::string& page);

  /// Each becomes an element of its own, base64; returns its address, "#rgs-file-0" and so on.
  std::string add(MappedFile file) { return add_part(std::move(file)); }
  std::string add(std::string text) { return add_part(std::move(text)); }
  /// What the page is told, with these addresses.
  void set_view(std::string_view json) { view_ = script_json(json); }

  std::uint64_t bytes() const;
  std::vector<const MappedFile*> inputs() const;
  /// Writes it from the beginning, block by block. Errors: write_failed.
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
