// scratch_file.hpp - bytes that are written and read again while levels are built.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::lod {

/// In memory, or in a file without a name that vanishes with the process, however that ends. Reading is thread-safe, and so is
/// writing to a file.
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
  /// Bytes that have been written. Errors: read_failed.
  Status read(std::uint64_t offset, std::span<std::byte> bytes) const;

 private:
  int fd_ = -1;
  std::vector<std::byte> memory_;
};

/// Whether it is an error of a scratch file, and so of the folder that it is in: not of an input or the output.
bool concerns_scratch(const Error& error);

}  // namespace rgs::lod
