// input_files.hpp - the files that a program reads: none of them becomes an output, none may change meanwhile.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/result.hpp"

namespace rgs::tool {

/// What a path stands for on disk: the file there or, where there is none, a place in a folder. Different names of one
/// file (links, "./a", "A/../a") have the same. "-" is what standard input or output has been redirected to.
struct FileIdentity {
  std::uint64_t device = 0, inode = 0;  ///< of the file, or of the innermost folder on its path that exists
  std::string name;                     ///< from that folder on; empty if the file exists

  bool operator==(const FileIdentity&) const = default;
};

/// What is said of a file that changed.
inline constexpr Error kFileChanged{.code = Errc::read_failed,
                                    .what = "the file changed while it was read; run the program again"};

class InputFiles {
 public:
  /// Adds a file. Nothing happens for an empty path.
  void add(const std::string& path);
  /// Adds a scene: of a SOG's meta.json also the pictures beside it.
  void add_scene(const std::string& path);
  /// Adds a camera file, or the files of the COLMAP model that a folder holds.
  void add_cameras(const std::string& path);
  /// Adds the pictures that lie in a folder.
  void add_pictures(const std::string& folder);

  const std::vector<std::string>& paths() const { return paths_; }

  /// An output that is one of the files, or is another output as well: a sentence with both names. Empty if all is well.
  /// Empty paths are passed over.
  std::string clash(std::span<const std::string> outputs) const;
  /// kSuccess, or clash() as reported to the user: kUsage.
  int check_outputs(std::span<const std::string> outputs) const;
  /// The first file that is not what it was when it was added: rewritten, extended, or another one under its name. A file
  /// that is gone is none, since whoever has opened it can read on.
  std::optional<std::string> changed() const;
  /// kSuccess, or changed() as reported to the user: that of read_failed.
  int check_unchanged() const;

 private:
  struct State {
    std::optional<FileIdentity> identity;
    bool exists = false;
    std::uint64_t bytes = 0;
    std::int64_t modified[2] = {}, status_changed[2] = {};  // seconds and nanoseconds
  };
  static State look(const std::string& path, int standard_stream);

  std::vector<std::string> paths_;
  std::vector<State> states_;
};

}  // namespace rgs::tool
