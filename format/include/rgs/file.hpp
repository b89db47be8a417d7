// file.hpp - files as the tools need them: mapped for reading, all-or-nothing for writing (POSIX).
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace RGS_API rgs {

/// A whole regular file mapped read-only. Pages are read when touched. Move-only.
class MappedFile {
 public:
  /// Errors: open_failed (missing, unreadable, a directory), read_failed (cannot be mapped).
  static Result<MappedFile> open(const std::string& path);
  /// Maps the open regular file `fd`; the descriptor stays the caller's.
  static Result<MappedFile> map(int fd);

  MappedFile() = default;
  MappedFile(MappedFile&& other) noexcept;
  MappedFile& operator=(MappedFile&& other) noexcept;
  ~MappedFile();

  std::span<const std::byte> bytes() const { return {data_, size_}; }
  /// read_failed if the file no longer has the size that was mapped. What is cut off reads as zeros up to the end of a
  /// page, and raises SIGBUS beyond it.
  Status check_size() const;
  /// Tells the kernel how [offset, offset + length) will be read next; a hint, never an error.
  enum class Access { normal, sequential, random, will_need, done };
  void advise(Access access, std::uint64_t offset = 0, std::uint64_t length = ~std::uint64_t{0}) const;

 private:
  const std::byte* data_ = nullptr;
  std::size_t size_ = 0;
  int fd_ = -1;  // of its own
};

/// An output that appears under its name complete or not at all. Bytes go to `PATH.tmp-XXXXXX` in the same folder;
/// commit() syncs and renames. Destruction without commit, SIGINT, SIGTERM and SIGHUP (after
/// remove_temporaries_on_signal()) remove the temporary file. Path "-" is standard output: bytes are collected in an
/// unlinked file in $TMPDIR (/tmp if unset) and copied out by commit(). Move-only; writes may come from several
/// threads.
class AtomicFile {
 public:
  struct Options {
    bool overwrite = false;  ///< replace an existing file; otherwise commit() and create() refuse with output_exists
    bool sync = true;        ///< fsync file and folder before commit() returns
    std::vector<const MappedFile*> inputs = {};  ///< commit() asks each of them for check_size() first
  };
  /// Errors: output_exists, output_unusable (a directory), write_failed.
  static Result<AtomicFile> create(const std::string& path, const Options& options);

  AtomicFile() = default;
  AtomicFile(AtomicFile&& other) noexcept;
  AtomicFile& operator=(AtomicFile&& other) noexcept;
  ~AtomicFile();

  /// Reserves `size` bytes so that a full disk shows now (write_failed, errno ENOSPC) and not at the end.
  Status reserve(std::uint64_t size);
  Status write_at(std::uint64_t offset, std::span<const std::byte> bytes);
  /// Bytes that have been written. Errors: read_failed.
  Status read_at(std::uint64_t offset, std::span<std::byte> bytes) const;
  /// Makes the output end at `size`.
  Status truncate(std::uint64_t size);
  /// Syncs if asked for, then renames. Seconds spent in fsync are returned.
  Result<double> commit();
  int descriptor() const { return fd_; }

 private:
  static Result<AtomicFile> begin(const std::string& path, const Options& options);
  Result<double> finish();
  void discard();
  Status copy_to_stdout();
  std::string path_, temporary_;
  Options options_;
  int fd_ = -1;
  int slot_ = -1;  // entry in the table that the signal handler walks
};

/// Installs handlers for SIGINT, SIGTERM and SIGHUP, unless ignored (nohup), that remove unfinished outputs and then
/// die of the same signal, and for SIGBUS, which a mapped input raises when another process truncates it: outputs are
/// removed, exit code 3. SIGXFSZ is ignored, so that writes beyond a size limit are write_failed.
void remove_temporaries_on_signal();

/// True if both paths name the same existing file (device and inode).
bool same_file(const std::string& a, const std::string& b);

}  // namespace rgs
