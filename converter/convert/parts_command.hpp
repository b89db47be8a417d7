// parts_command.hpp - rgs-convert --lod-partition, --lod-build, --lod-assemble and --lod-list: which steps are run, and what is
// said of them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <optional>
#include <string>

#include "failure.hpp"
#include "parts.hpp"

namespace rgs {

struct PartsCommand {
  std::string partition, build, assemble, list;  ///< folders; the one that is given says what is done
  std::string selected = "all";                  ///< inputs or ranges: all, none, K or K-M
  std::uint32_t n_ranges = 0;                    ///< 0: not given
  bool overwrite = false, json = false, quiet = false;

  /// That of the folder; empty: another conversion.
  const std::string& folder() const;
};

/// Numbers that a process takes. None if the text says no such thing.
struct Selection {
  std::size_t first = 0,
              last = ~std::size_t{0};  ///< of these `first` to `last`, the last one too; none if last < first
  bool is_part = false;
};
std::optional<Selection> parse_selection(const std::string& text);

/// Runs the steps and reports what fails, each file by its name: those that are left go on. `describe` gives the job where inputs
/// are named, and is empty where they are not. Returns the exit code, the worst of all.
int run_parts(const PartsCommand& command, const PartsRun& run, const std::function<Outcome<PartsJob>()>& describe,
              const std::string& output_path, const AtomicFile::Options& output);

}  // namespace rgs
