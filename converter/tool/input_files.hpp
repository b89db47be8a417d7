// input_files.hpp - the files that a program reads: an output must not replace them, and they must not change
// meanwhile.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "rgs/file.hpp"
#include "rgs/result.hpp"

namespace rgs::tool {

/// Identifies the file at a path or, where there is none, the path within an existing folder. Different names of one
/// file (links, "./a", "A/../a") are equal. "-" is the file to which standard input or output is redirected.
struct FileIdentity {
  std::uint64_t device = 0, inode = 0;  ///< of the file, or of the innermost folder on its path that exists
  std::string name;                     ///< the rest of the path; empty if the file exists

  bool operator==(const FileIdentity&) const = default;
};

/// The name of the .prj of a PLY: the same but for the ending; empty for other files.
std::string prj_of(const std::string& path);

/// The error for a file that changed.
inline constexpr Error kFileChanged{.code = Errc::read_failed,
                                    .what = "the file changed while it was read; run the program again"};

class InputFiles {
 public:
  /// Adds a file; ignores an empty path.
  void add(const std::string& path);
  /// Adds a scene, with the pictures beside a SOG's meta.json, the SOGs below a lod-meta.json, files_of_tileset(), the
  /// .bin beside an .lcc or .gltf, the chunks of an .lcc2 or .rad, the .prj of a PLY.
  void add_scene(const std::string& path);
  /// Adds a camera file, or the files of a COLMAP model's folder.
  void add_cameras(const std::string& path);
  /// Adds the pictures in a folder.
  void add_pictures(const std::string& folder);

  const std::vector<std::string>& paths() const { return paths_; }

  /// A sentence naming an output that is also an input, or that is given twice; empty if there is none. Ignores empty
  /// paths.
  std::string clash(std::span<const std::string> outputs) const;
  /// Reports clash() to the user; kUsage or kSuccess.
  int check_outputs(std::span<const std::string> outputs) const;
  /// The first file that changed since it was added: rewritten, extended or replaced. A file that is gone does not
  /// count: whoever opened it can read on.
  std::optional<std::string> changed() const;
  /// Reports changed() to the user; the exit code of read_failed, or kSuccess.
  int check_unchanged() const;

 private:
  struct State {
    std::optional<FileIdentity> identity;
    std::optional<detail::FileStatus> status;  // of a file that exists
  };
  static State look(const std::string& path, int standard_stream);

  std::vector<std::string> paths_;
  std::vector<State> states_;
};

}  // namespace rgs::tool
