// streamed_output.hpp - the files of a streamed SOG or a tileset: a folder, or a zip archive.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs {

/// The folder, beside a tileset's JSON, of its tiles: "tiles" of tileset.json, "b" of b.json, "b~cd" of b:d.json, so
/// that tilesets of one folder have folders of their own.
std::string folder_of_tiles(const std::string& path);

/// A path that ends with ".json" is the last file put, and the others lie in folders beside it; any other is a zip
/// archive of all, stored. Nothing is seen before commit(). Files of a folder are first written below `PATH.tmp-XXXXXX`, which
/// destruction removes and a killed program leaves behind; commit() renames one by one, and that at the path last: a
/// program killed meanwhile leaves no file at the path.
class StreamedOutput {
 public:
  /// Whether a path leads to a file that is read.
  using IsInput = std::function<bool(const std::string& path)>;
  /// Makes the folder of the path. Errors: AtomicFile::create()'s, write_failed.
  static Result<StreamedOutput> create(const std::string& path, const AtomicFile::Options& options,
                                       const IsInput& is_input = {});
  StreamedOutput(StreamedOutput&& other) noexcept = default;
  StreamedOutput& operator=(StreamedOutput&& other) = delete;
  ~StreamedOutput();

  /// Files in any order, that at the path last. Errors: write_failed; output_exists; output_unusable; limit_exceeded
  /// (an archive of 4 GiB or 65,534 files).
  Status put(const std::string& name, std::span<const std::byte> bytes);
  /// Returns the seconds spent in fsync. Errors: AtomicFile's; output_exists and output_unusable leave all as it was.
  Result<double> commit();
  std::uint64_t bytes() const { return bytes_; }

 private:
  StreamedOutput() = default;
  bool is_zip() const { return staging_.empty(); }
  Status put_zipped(const std::string& name, std::span<const std::byte> bytes);
  Status check_free(const std::string& path) const;
  Status put_in_folder(const std::string& name, std::span<const std::byte> bytes);
  AtomicFile::Options options_;
  IsInput is_input_;
  AtomicFile file_;             // at the path
  std::string path_, staging_;  // staging_: a folder beside the path; empty: none
  std::vector<std::string> names_;
  std::vector<std::byte> directory_;  // of the zip archive
  std::uint64_t bytes_ = 0;
  double sync_seconds_ = 0;
  bool made_folder_ = false;
};

/// A file, or the StreamedOutput of a streamed SOG or tileset.
class SceneOutput {
 public:
  /// Errors: those of StreamedOutput and AtomicFile.
  Status create(SplatFormat format, const std::string& path, const AtomicFile::Options& options,
                const StreamedOutput::IsInput& is_input) {
    if (format == SplatFormat::tileset || format == SplatFormat::ssog) {
      auto folder = StreamedOutput::create(path, options, is_input);
      if (!folder) return tl::unexpected(folder.error());
      folder_.emplace(std::move(*folder));
      return {};
    }
    auto file = AtomicFile::create(path, options);
    if (!file) return tl::unexpected(file.error());
    file_ = std::move(*file);
    return {};
  }
  /// Of one file only once, whatever its name.
  Status put(const std::string& name, std::span<const std::byte> bytes) {
    if (folder_) return folder_->put(name, bytes);
    bytes_ = bytes.size();
    return file_.write_at(0, bytes);
  }
  Result<double> commit() { return folder_ ? folder_->commit() : file_.commit(); }
  std::uint64_t bytes() const { return folder_ ? folder_->bytes() : bytes_; }

 private:
  AtomicFile file_;
  std::optional<StreamedOutput> folder_;
  std::uint64_t bytes_ = 0;
};

}  // namespace rgs
