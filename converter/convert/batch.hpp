// batch.hpp - many scenes, one conversion each, in processes of their own: rgs-convert of folders and lists.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "convert.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs {

/// One scene of many, and where it goes.
struct BatchScene {
  std::string name, input;  ///< as a user calls it; its path
  std::string output;       ///< relative to the folder of the outputs, or absolute
  std::string output_path;
  std::uint64_t bytes = 0;
  bool named = false;  ///< in a list: that it is no scene is an error
  Status readable;
};

/// An error and the file that it is about.
struct BatchFailure {
  std::string file;
  Error error;
};

struct BatchOptions {
  std::string out;           ///< folder of the outputs
  std::string report;        ///< file of the lines; empty: standard output
  std::string options_hash;  ///< of all options that show in an output
  std::string tool;          ///< program and version
  unsigned jobs = 1, threads = 1;
  unsigned shard = 1, n_shards = 1;
  bool keep_going = true, overwrite = false, sync = true, quiet = false, json = false;
  std::uint64_t n_others = 0;  ///< files that were passed over
};

/// What a process of its own has to convert a scene with.
struct BatchShare {
  unsigned threads = 1;
  bool overwrite = false;   ///< whatever is there is ours
  bool unfinished = false;  ///< a conversion of it was begun and may have left its temporary file
};

/// Converts one scene to scene.output_path. Called in a child process, which ends afterwards.
using BatchConvert =
    std::function<tl::expected<ConvertSummary, BatchFailure>(const BatchScene& scene, const BatchShare& share)>;

/// Takes from `scenes` those of one shard: the largest first, each to the shard that has least so far, so that
/// the same list is split in the same way everywhere.
std::vector<BatchScene> scenes_of_shard(std::vector<BatchScene> scenes, unsigned shard, unsigned n_shards);

/// Whether a report can be written to `path`: nothing is there, or an earlier report, or `overwrite`. Errors: output_exists,
/// those of AtomicFile::create().
Status check_report(const std::string& path, bool overwrite);

/// The files in the folder `out` that remember what was made: that of these options, then others that are there.
std::vector<std::string> state_files(const std::string& out, const BatchOptions& options);

/// Makes the folder of the outputs where there is none. An exit code; errors are printed.
int make_folder(const std::string& path);

/// Converts what is not done already, prints or writes a line for each scene and a summary. Returns the worst exit code,
/// see tool::worse_exit_code().
int run_batch(std::vector<BatchScene> scenes, const BatchOptions& options, const BatchConvert& convert);

}  // namespace rgs
