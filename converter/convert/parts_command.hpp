// parts_command.hpp - rgs-convert --lod-partition, --lod-build, --lod-assemble and --lod-list: runs and reports their
// steps.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <optional>
#include <string>

#include "failure.hpp"
#include "parts.hpp"

namespace rgs {

struct PartsCommand {
  std::string partition, build, assemble, list;  ///< folders; exactly one is given and chooses the command
  std::string selected = "all";                  ///< inputs or ranges: all, none, K or K-M
  std::uint32_t n_ranges = 0;                    ///< 0: not given
  bool overwrite = false, json = false, quiet = false;

  /// The given folder; empty: another kind of conversion.
  const std::string& folder() const;
};

/// The inputs or ranges of this process. None if the text is not valid.
struct Selection {
  std::size_t first = 0, last = ~std::size_t{0};  ///< `first` to `last` inclusive; none if last < first
  bool is_part = false;
};
std::optional<Selection> parse_selection(const std::string& text);

/// Runs the steps and reports each failure by its file; the others go on. `describe` returns the job if inputs are
/// named, and is empty otherwise. Returns the worst exit code.
int run_parts(const PartsCommand& command, const PartsRun& run, const std::function<Outcome<PartsJob>()>& describe,
              const std::string& output_path, const AtomicFile::Options& output);

}  // namespace rgs
