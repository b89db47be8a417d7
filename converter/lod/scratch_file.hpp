// scratch_file.hpp - scratch bytes, in memory or in a file, for building levels.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::lod {

/// In memory, or in an unnamed file that vanishes with the process. Reading is thread-safe, and so is writing, unless
/// it makes memory grow.
class ScratchFile {
 public:
  ScratchFile() = default;  ///< in memory
  /// A file in `folder`. Errors: open_failed.
  static Result<ScratchFile> create(const std::string& folder);
  ScratchFile(ScratchFile&& other) noexcept;
  ScratchFile& operator=(ScratchFile&& other) noexcept;
  ~ScratchFile();

  /// Errors: write_failed (the folder is full), host_out_of_memory.
  Status write(std::uint64_t offset, std::span<const std::byte> bytes);
  /// Reads bytes that were written. Errors: read_failed.
  Status read(std::uint64_t offset, std::span<std::byte> bytes) const;

 private:
  int fd_ = -1;
  std::vector<std::byte> memory_;
};

/// Whether the error is a scratch file's, so that its folder is to blame and not an input or the output.
bool concerns_scratch(const Error& error);

}  // namespace rgs::lod
