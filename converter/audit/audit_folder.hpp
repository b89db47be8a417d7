// audit_folder.hpp - many pairs at once, with a table of all, resumable.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "audit.hpp"

namespace rgs::audit {

struct FolderOptions {
  Options audit;                      ///< source and asset are folders; cameras and photos serve all pairs, or are
                                      ///< folders with STEM.json and STEM/ for each
  std::vector<Condition> conditions;  ///< for every pair
  std::string out;                    ///< folder for STEM.html, STEM.json and index.html, index.csv, index.json
  bool overwrite = false;             ///< replace results of other inputs or options; results that hold are kept
  bool quiet = false;
};

/// One pair in the table.
struct FolderRow {
  enum class Status : std::uint8_t { passed, gate_failed, error, unpaired };
  std::string stem, headline, error;
  std::string grade;  ///< Verdict::Grade as in the JSON; empty without a result
  Status status = Status::error;
  int exit_code = 0;
  bool reused = false;  ///< an earlier result with the same fingerprint
  std::uint64_t source_bytes = 0, asset_bytes = 0, n_gaussians = 0;
  double ratio = 0, bytes_per_gaussian = 0;
  std::uint64_t n_views = 0, n_rated = 0;
  std::optional<double> psnr, worst_psnr, ssim, loss;  ///< infinite for identical pictures; absent if not rated
  /// Of levels of detail, by kDistances: absent without, and for distances that were left out.
  std::array<std::optional<double>, 4> levels_psnr, levels_drawn;
};

/// Audits every SOURCE/x.ply with ASSET/x.rgs, in the order of their names; a failure is a row and does not stop the
/// others. The tables are rewritten after every pair, so that an interrupted run leaves what it has done, and a later
/// one goes on from there. Prints a line a pair unless quiet.
Outcome<std::vector<FolderRow>> audit_folder(const FolderOptions& options);

/// 0 if all passed; else the exit code of the first error, or 5 if only conditions failed.
int exit_code_of(const std::vector<FolderRow>& rows);

}  // namespace rgs::audit
