// served_file.hpp - a file that is given out as it was when the program started, or not at all.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>

#include "rgs/result.hpp"

namespace rgs::view {

/// By which a file is known again: another one under its name, and one that was written to, have others.
struct FileStamp {
  std::uint64_t device = 0, inode = 0, bytes = 0, names = 0;
  std::int64_t modified_ns = 0, changed_ns = 0;

  /// Whether it is that file, unchanged. A name that was given to it or taken from it changes nothing.
  bool same(const FileStamp& other) const;
};

/// Bytes of a file that is open. Several threads may read.
class OpenFile {
 public:
  OpenFile(int descriptor, const FileStamp& stamp) : fd_(descriptor), stamp_(stamp) {}
  ~OpenFile();
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;

  std::uint64_t size() const { return stamp_.bytes; }
  /// Fills `out` from `offset` on; read_failed also where the file is not what it was when the program started.
  Status read_at(std::uint64_t offset, std::span<char> out) const;

 private:
  int fd_;
  FileStamp stamp_;
};

class ServedFile {
 public:
  /// Looks at the file, which must be a regular one. Errors: open_failed.
  static Result<ServedFile> look(const std::string& path);

  const std::string& path() const { return path_; }
  std::uint64_t size() const { return stamp_.bytes; }
  /// The entity tag, in quotes: inode, size and time of the last change.
  std::string tag() const;
  /// Errors: open_failed, read_failed (it changed).
  Result<std::shared_ptr<const OpenFile>> open() const;

 private:
  std::string path_;
  FileStamp stamp_;
};

/// Content-Type by the name's ending; application/octet-stream for all that browsers need not know.
const char* content_type(std::string_view path);

}  // namespace rgs::view
