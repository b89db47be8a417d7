// served_file.hpp - serves a file only while it is as it was when the program started.
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

/// Identifies a file and its contents: changes when the file is written or replaced.
struct FileStamp {
  std::uint64_t device = 0, inode = 0, bytes = 0, names = 0;
  std::int64_t modified_ns = 0, changed_ns = 0;

  /// Whether it is the same unchanged file. Adding or removing a hard link is no change.
  bool same(const FileStamp& other) const;
};

/// An open file. Several threads may read it.
class OpenFile {
 public:
  OpenFile(int descriptor, const FileStamp& stamp) : fd_(descriptor), stamp_(stamp) {}
  ~OpenFile();
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;

  std::uint64_t size() const { return stamp_.bytes; }
  /// Fills `out` from `offset` on. Errors: read_failed (also if the file has changed since the program started).
  Status read_at(std::uint64_t offset, std::span<char> out) const;

 private:
  int fd_;
  FileStamp stamp_;
};

class ServedFile {
 public:
  /// Records a regular file's stamp. Errors: open_failed.
  static Result<ServedFile> look(const std::string& path);

  const std::string& path() const { return path_; }
  std::uint64_t size() const { return stamp_.bytes; }
  /// The entity tag, in quotes: inode, size and modification time.
  std::string tag() const;
  /// Errors: open_failed, read_failed (it changed).
  Result<std::shared_ptr<const OpenFile>> open() const;

 private:
  std::string path_;
  FileStamp stamp_;
};

/// Content-Type by the name's ending, else application/octet-stream.
const char* content_type(std::string_view path);

}  // namespace rgs::view
