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
  /// read_failed if the file has another size than the one that was mapped, or has been written to since: by its times of
  /// modification and of change, the latter unless a name was given or taken meanwhile. What is cut off reads as zeros up
  /// to the end of a page, and raises SIGBUS beyond it.
  Status check_unchanged() const;
  /// Tells the kernel how [offset, offset + length) will be read next; a hint, never an error.
  enum class Access { normal, sequential, random, will_need, done };
  void advise(Access access, std::uint64_t offset = 0, std::uint64_t length = ~std::uint64_t{0}) const;

 private:
  const std::byte* data_ = nullptr;
  std::size_t size_ = 0;
  int fd_ = -1;  // of its own
  struct Stamp {
    std::int64_t modified[2] = {}, changed[2] = {};  // seconds and nanoseconds
    std::uint64_t n_names = 0;
  } stamp_;
};

/// An output that appears under its name complete or not at all. Bytes go to `PATH.tmp-XXXXXX` in the same folder;
/// commit() syncs and renames. Destruction without commit, SIGINT, SIGTERM, SIGHUP and SIGPIPE (after
/// remove_temporaries_on_signal()) remove the temporary file; SIGKILL and a loss of power leave it behind, for the user to
/// delete. A symbolic link is followed: its target is what is written and replaced, with the temporary file beside it. What
/// replaces a file takes over its permissions, and its owner and group where the process may give them; access control
/// lists, extended attributes and further hard links stay with the old file. Path "-" is standard output: bytes are
/// collected in an unlinked file in $TMPDIR (/tmp if unset) and copied out by commit(). No descriptor is that of a standard
/// stream, so that messages cannot end up in a file. Move-only; writes may come from several threads.
class AtomicFile {
 public:
  struct Options {
    bool overwrite = false;  ///< replace an existing file; otherwise commit() and create() refuse with output_exists
    bool sync = true;        ///< fsync file and folder before commit() returns
    std::vector<const MappedFile*> inputs = {};  ///< commit() asks each of them for check_unchanged() first
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
  static Result<AtomicFile> begin(const std::string& name, const Options& options);
  Result<double> finish();
  void discard();
  Status copy_to_stdout();
  std::string path_, temporary_;
  Options options_;
  int fd_ = -1;
  int slot_ = -1;  // entry in the table that the signal handler walks
};

/// Installs handlers for SIGINT, SIGTERM, SIGHUP and SIGPIPE, unless ignored (nohup), that remove unfinished outputs and then
/// die of the same signal, and for SIGBUS, which a mapped input raises when another process truncates it: outputs are
/// removed, exit code 3. SIGXFSZ is ignored, so that writes beyond a size limit are write_failed.
void remove_temporaries_on_signal();

/// What `path` stands for: the target of a symbolic link, and of the links that this leads to, whether it exists or not;
/// anything else as it is.
std::string follow_links(const std::string& path);

}  // namespace rgs
