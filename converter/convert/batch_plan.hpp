// batch_plan.hpp - which scenes are converted, and to which names: of a folder or a list.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "batch.hpp"
#include "rgs/interchange.hpp"
#include "rgs/result.hpp"

namespace rgs {

struct BatchPlan {
  std::vector<BatchScene> scenes;
  std::uint64_t n_others = 0;        ///< files in the folder that are no scenes
  std::vector<std::string> refused;  ///< links to folders that contain them
};

/// What is wrong with a command, or with a file.
struct PlanFailure {
  std::string usage;  ///< a message; empty: `error`, of `file`
  std::string file = {};
  Error error = {};
};

/// The lines of a list of files, "-" for standard input; empty ones too. Errors: open_failed, read_failed.
Result<std::vector<std::string>> lines_of(const std::string& list);

/// The scenes below `folder`, or those named in the file `list` ("-": standard input), relative to `folder` if there is one
/// (both may be empty, not both at once). a/b.ply of a folder becomes out/a/b.ENDING, with the ending of format `to`; so
/// does a relative path in a list, others lose their folders. A line of a list may name its output after a tab.
tl::expected<BatchPlan, PlanFailure> plan_batch(const std::string& list, const std::string& folder,
                                                const std::string& out, SplatFormat to);

/// Two scenes that would have one output: a sentence with all three names. Empty if there are none.
std::string outputs_that_clash(const BatchPlan& plan, const std::string& out);

/// Hash of options as text and of the contents of the cameras. Errors: those of MappedFile::open().
Result<std::string> options_hash(const std::string& given, const std::string& cameras);

}  // namespace rgs
