// spool_file.hpp - append-only scratch bytes: in memory while small, then in an unlinked temporary file.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/result.hpp"

namespace rgs::detail {

/// Append, finish(), then read bytes(). Holds at most 1 MiB in memory; more goes to an unnamed file in $TMPDIR (/tmp if
/// unset), which vanishes with the process. Not copyable.
class RGS_API SpoolFile {
 public:
  SpoolFile() = default;
  ~SpoolFile();
  SpoolFile(const SpoolFile&) = delete;
  SpoolFile& operator=(const SpoolFile&) = delete;

  /// Errors: open_failed (no temporary file can be made), write_failed (disk full).
  Status append(std::span<const std::byte> bytes);
  /// Errors: as append(), read_failed.
  Status finish();
  std::span<const std::byte> bytes() const { return spilled_ ? file_.bytes() : std::span<const std::byte>(buffer_); }
  /// The mapping behind bytes(); empty while they are in memory.
  const MappedFile& file() const { return file_; }

 private:
  Status flush();
  std::vector<std::byte> buffer_;
  MappedFile file_;
  std::uint64_t written_ = 0;
  int fd_ = -1;
  bool spilled_ = false;
};

}  // namespace rgs::detail
