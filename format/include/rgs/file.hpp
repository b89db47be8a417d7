// file.hpp - files for the programs: mapped for reading, all-or-nothing for writing.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace RGS_API rgs {

namespace detail {
/// What a file system says of a file.
struct FileStatus {
  enum class Kind { regular, folder, other } kind = Kind::other;
  std::uint64_t device = 0, inode = 0, bytes = 0, n_names = 0;
  std::array<std::int64_t, 2> modified{}, changed{};  ///< of contents, of anything (not on Windows): s and ns
  /// Whether `now`, a later status, shows the same contents. Writers may reset the time of modification, not of change.
  /// Making or removing a link changes that too, and does no harm.
  bool is_unchanged(const FileStatus& now) const {
    return now.bytes == bytes && now.modified == modified && (now.changed == changed || now.n_names != n_names);
  }
};
}  // namespace detail

/// A whole regular file mapped read-only. The system reads pages when they are touched. Move-only.
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
  /// read_failed if the file's size differs from the mapped one, or if it has been written to: by its times of
  /// modification and of change, the latter unless links were made or removed meanwhile. A truncated file reads as
  /// zeros up to the end of a page, and raises SIGBUS beyond.
  Status check_unchanged() const;
  /// Tells the kernel how [offset, offset + length) will be read; a hint, never an error.
  enum class Access { normal, sequential, random, will_need, done };
  void advise(Access access, std::uint64_t offset = 0, std::uint64_t length = ~std::uint64_t{0}) const;

 private:
  const std::byte* data_ = nullptr;
  std::size_t size_ = 0;
  int fd_ = -1;  // of its own
  detail::FileStatus stamp_;
};

/// An output that appears under its name complete or not at all. Its bytes go to a file without a name in the same folder,
/// gone with its process whatever ends that; commit() syncs it and links it to its name. To replace a file, commit() gives
/// it a second name, `PATH.tmp-XXXXXX`, and renames that: SIGKILL or power loss between the two calls leaves it behind.
/// Where the file system has no unnamed files (O_TMPFILE: NFS, FAT; or without /proc) all bytes go to `PATH.tmp-XXXXXX`;
/// destruction without commit, and SIGINT, SIGTERM, SIGHUP and SIGPIPE (after remove_temporaries_on_signal()), remove it.
/// A symbolic link is followed: its target is replaced. The new file takes over the old one's permissions, and owner and
/// group if the process may set them; access control lists, extended attributes and other hard links stay with the old
/// file. Path "-" is standard output: commit() copies out an unnamed file in $TMPDIR (/tmp if unset). No descriptor is a
/// standard stream's number, so messages cannot end up in a file. On Windows all bytes go to `PATH.tmp-XXXXXX`, which
/// Ctrl-C removes and a killed process leaves behind. Move-only; several threads may write.
class AtomicFile {
 public:
  struct Options {
    bool overwrite = false;  ///< replace an existing file; otherwise create() and commit() fail with output_exists
    bool sync = true;        ///< fsync file and folder before commit() returns
    std::vector<const MappedFile*> inputs = {};  ///< commit() first calls check_unchanged() of each
    AtomicFile* hold = nullptr;  ///< commit() moves the complete file here instead; a second commit() gives it its name
  };
  /// Errors: output_exists, output_unusable (a directory), write_failed.
  static Result<AtomicFile> create(const std::string& path, const Options& options);

  AtomicFile() = default;
  AtomicFile(AtomicFile&& other) noexcept;
  AtomicFile& operator=(AtomicFile&& other) noexcept;
  ~AtomicFile();

  /// Reserves `size` bytes, so that a full disk fails now (write_failed, errno ENOSPC) and not at the end.
  Status reserve(std::uint64_t size);
  Status write_at(std::uint64_t offset, std::span<const std::byte> bytes);
  /// Reads written bytes back. Errors: read_failed.
  Status read_at(std::uint64_t offset, std::span<std::byte> bytes) const;
  /// Sets the output's size.
  Status truncate(std::uint64_t size);
  /// Syncs if requested, then gives the file its name. Returns the seconds spent in fsync.
  Result<double> commit();
  int descriptor() const { return fd_; }

 private:
  static Result<AtomicFile> begin(const std::string& name, const Options& options);
  Result<double> finish();
  void take_name(std::string name);
  void discard();
  Status copy_to_stdout();
  std::string path_, temporary_;
  Options options_;
  int fd_ = -1;
  int slot_ = -1;  // entry in the signal handler's table
};

/// Installs handlers for SIGINT, SIGTERM, SIGHUP and SIGPIPE, unless ignored (nohup), that remove unfinished outputs
/// and then die of the same signal; and for SIGBUS, raised when another process truncates a mapped input: it removes
/// outputs and exits with code 3. Ignores SIGXFSZ, so that writes beyond a size limit are write_failed.
void remove_temporaries_on_signal();

/// The final target of a symbolic link, through further links, whether it exists or not; any other path unchanged.
std::string follow_links(const std::string& path);

namespace detail {
/// A scratch file in `folder` (empty: the system's folder for such, $TMPDIR), without a name: its bytes are released when it is
/// closed, whatever ends the process. Returns a descriptor above the standard streams' numbers, or -1 and errno.
int open_scratch(const std::string& folder);
/// Makes a folder, after it has put other letters for the Xs at the end of `name`, "...XXXXXX". False and errno on failure.
bool make_scratch_folder(std::string& name);
/// A descriptor for reading, above the standard streams' numbers, or -1 and errno. Without `wait` it does not wait
/// for the writer of a pipe.
int open_to_read(const std::string& path, bool wait = true);
/// Of the file at a path, through links, or of an open one; nothing and errno on failure.
std::optional<FileStatus> status_of(const std::string& path);
std::optional<FileStatus> status_of(int fd);
/// Of an open regular file. Errors: open_failed.
Result<FileStatus> status_of_regular(int fd);
/// Writes or reads all bytes at `offset`, which moves on with them. Returns 0, errno, or kFileEnded. Thread-safe.
int write_at(int fd, std::uint64_t& offset, std::span<const std::byte> bytes);
int read_at(int fd, std::uint64_t& offset, std::span<std::byte> bytes);
inline constexpr int kFileEnded = -1;
}  // namespace detail

}  // namespace rgs
