// batch_plan.hpp - chooses the scenes of a folder or list, and the names of their outputs.
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
  std::uint64_t n_others = 0;        ///< files in the folder that are not scenes
  std::vector<std::string> refused;  ///< links to folders that contain them
};

/// The lines of a file, "-" for standard input, empty lines included. Errors: open_failed, read_failed.
Result<std::vector<std::string>> lines_of(const std::string& list);

/// The scenes below `folder`, or those named in the file `list` ("-": standard input), relative to `folder` if given
/// (one of the two may be empty). A folder's a/b.ply becomes out/a/b.ENDING with the ending of format `to`; so does a
/// relative path in a list, other paths lose their folders. A line of a list may name its output after a tab.
/// Prints errors and returns the exit code instead.
tl::expected<BatchPlan, int> plan_batch(const std::string& list, const std::string& folder, const std::string& out,
                                        SplatFormat to);

/// A sentence with all three names if two scenes would have the same output; empty otherwise.
std::string outputs_that_clash(const BatchPlan& plan, const std::string& out);

/// Hash of the options' text and the cameras' contents. Errors: those of MappedFile::open().
Result<std::string> options_hash(const std::string& given, const std::string& cameras);

}  // namespace rgs
