// batch.hpp - rgs-convert of folders and lists: many scenes, each converted in a process of its own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "convert.hpp"
#include "failure.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs {

struct BatchScene {
  std::string name, input;  ///< the user's name for it; its path
  std::string output;       ///< relative to the output folder, or absolute
  std::string output_path;
  std::uint64_t bytes = 0;
  bool named = false;  ///< from a list: it is an error if it is not a scene
  Status readable;
};

struct BatchOptions {
  std::string out;           ///< output folder
  std::string report;        ///< file for the report lines; empty: standard output
  std::string options_hash;  ///< of all options that affect an output
  std::string tool;          ///< program and version
  unsigned jobs = 1, threads = 1;
  unsigned shard = 1, n_shards = 1;
  bool keep_going = true, overwrite = false, sync = true, quiet = false, json = false;
  std::uint64_t n_others = 0;  ///< files that were ignored
  /// Reads a whole output. If set, existing outputs are read, and those that it finds damaged are replaced.
  std::function<Status(const std::string& path)> check_output;
};

/// A child's share of resources, and what it may do.
struct BatchShare {
  unsigned threads = 1;
  bool overwrite = false;   ///< replace an existing file
  bool unfinished = false;  ///< an earlier conversion may have left its temporary file
};

/// Converts one scene to scene.output_path. Called in a child process, which then ends.
using BatchConvert = std::function<Outcome<ConvertSummary>(const BatchScene& scene, const BatchShare& share)>;

/// The scenes of one shard: each scene, largest first, goes to the shard with the least so far. Every machine splits
/// the same list the same way.
std::vector<BatchScene> scenes_of_shard(std::vector<BatchScene> scenes, unsigned shard, unsigned n_shards);

/// Whether a report can be written to `path`: no file or an earlier report is there, or `overwrite`. Errors:
/// output_exists, those of AtomicFile::create().
Status check_report(const std::string& path, bool overwrite);

/// State files in the folder `out`: that of these options, then any others.
std::vector<std::string> state_files(const std::string& out, const BatchOptions& options);

/// Creates the output folder if needed. Returns an exit code; prints errors.
int make_folder(const std::string& path);

/// Converts scenes that are not done yet, prints or writes a line for each, and a summary. Returns the worst exit code,
/// see tool::worse_exit_code().
int run_batch(std::vector<BatchScene> scenes, const BatchOptions& options, const BatchConvert& convert);

}  // namespace rgs
