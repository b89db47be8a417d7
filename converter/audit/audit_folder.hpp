// audit_folder.hpp - audits many pairs, resumably, and tabulates them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <map>
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
  std::string junit = {};             ///< file for the outcome as JUnit XML; may be empty
  bool overwrite = false;             ///< replace results of other inputs or options; valid results are kept
  bool quiet = false;
};

struct FolderRow {
  enum class Status : std::uint8_t { passed, gate_failed, error, unpaired };
  std::string stem, headline, error;
  std::vector<Condition> gate = {};  ///< with the measured values
  double seconds = 0;                ///< of the audit, also if it is an earlier one
  std::string grade;                 ///< Verdict::Grade as in the JSON; empty without a result
  Status status = Status::error;
  int exit_code = 0;
  bool reused = false;  ///< an earlier result with the same fingerprint, under the current conditions
  std::uint64_t source_bytes = 0, asset_bytes = 0, n_gaussians = 0;
  double ratio = 0, bytes_per_gaussian = 0;
  std::uint64_t n_views = 0, n_rated = 0;
  std::optional<double> psnr, worst_psnr, ssim, loss;  ///< infinite for identical pictures; absent if not rated
  /// By kDistances; absent without levels of detail and for omitted distances.
  std::array<std::optional<double>, 4> levels_psnr, levels_drawn;
};

/// Paths of a pair; an empty one has `error` as reason.
struct Pair {
  std::string source, asset, error;
};
/// The scenes below SOURCE and ASSET (which may be one folder) by their names without endings, "a/b" for SOURCE/a/b.spz
/// and ASSET/a/b.rgs. A source has any format, but .rgs only without an alternative and if the folders differ; an asset
/// is an .rgs or, if there is a source and no .rgs, of any format. Skips files that are not scenes. Errors: those of
/// tool::list_scenes(); bad_argument if nothing is found.
Outcome<std::map<std::string, Pair>> pairs_of(const Options& options);

/// Audits every pair in order of names; a failure becomes a row and does not stop the others. The tables are rewritten
/// after every pair, so that an interrupted run keeps its results and a later one continues; changed conditions are
/// evaluated on earlier measurements. Prints a line a pair unless quiet.
Outcome<std::vector<FolderRow>> audit_folder(const FolderOptions& options);

/// The row of a single pair, for junit_xml().
FolderRow row_of(const Report& report);
FolderRow failed_row(const std::string& stem, const Failure& failure);

/// Writes a text; "-" is standard output. Errors: those of AtomicFile.
Status write_text(const std::string& path, const std::string& text, bool overwrite);

/// The worst of all pairs, see tool::worse_exit_code().
int exit_code_of(const std::vector<FolderRow>& rows);

}  // namespace rgs::audit
