// parts.hpp - converts one scene to levels of detail in many processes that share a folder. docs/user/CLUSTER.md "One
// scene".
// SPDX-License-Identifier: Apache-2.0
//
// The steps, and the files that they write into the folder. Each step may be killed and run again, and skips what is
// done:
//   begin     job       reads all inputs' headers: the options, and what the other steps need of each input
//   scan      scan.K    of input K: its damage, bounds and ranges of values, its hash, a sample of its means
//   plan      plan      combines the scans and cuts the Morton curve into bins that fit into memory
//   place     rows.K    the Gaussians of input K by bin
//   build     range.R   the stretches of range R: leaves, levels, pages as stored, or as values for an archive
//   assemble            the levels above the stretches, and the file
// The file has the bytes of convert_to_levels(), whatever the inputs per process and the ranges.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "convert.hpp"
#include "failure.hpp"
#include "rgs/encode.hpp"
#include "rgs/interchange.hpp"
#include "rgs/scene_scan.hpp"
#include "tile_stream.hpp"
#include "work_file.hpp"

namespace rgs {

struct PartsInput {
  std::string path, name;                    ///< absolute; without folders
  std::uint64_t bytes = 0, prefix_xxh3 = 0;  ///< see hash_of_prefix()
  SplatFormat format = SplatFormat::unknown;
  Axes axes = kAxes3dgs;
  Similarity placed;
  TileFacts facts;
  std::uint64_t first = 0;  ///< position of its first Gaussian among those of all inputs
};

/// Hash of the first 64 KiB, where formats declare things: the job's facts about an input must not change.
std::uint64_t hash_of_prefix(std::span<const std::byte> input);

struct PartsJob {
  std::vector<PartsInput> inputs;
  ReadOptions read;
  EncodeOptions encode;  ///< declared and requested, for all inputs
  lod::Quality quality = lod::Quality::fast;
  std::uint32_t n_ranges = 1;
  std::uint64_t bin_rows = 0;  ///< approximate Gaussians of a bin
  std::string cameras;         ///< path; empty: none
  std::string cameras_hash;    ///< options_hash() of no options and these cameras
  std::optional<float> z_near, z_far;
  bool strict = false, allow_rounding = false;
  int sh_degree = 0;  ///< of the inputs
  std::uint64_t n = 0;
  std::string source_format;
  std::vector<std::string> unused, notes;
  std::uint64_t identity = 0;

  int output_degree() const { return std::min(sh_degree, encode.sh_degree); }
};

struct PartsPlan {
  SceneScan scan{0};
  EncodeOptions encode;             ///< all options of the file except positions
  std::vector<std::uint64_t> bins;  ///< first Morton key of each; starts with 0
  std::uint64_t identity = 0;
};

/// The environment of a process; of this only `build` affects the output.
struct PartsRun {
  std::string folder;
  std::uint64_t memory_bytes = lod::kDefaultMemory;
  std::string scratch;
  bool sync = true;
  lod::BuildOptions build;  ///< except quality and chunks; the same in all processes
  StageObserver observer;

  std::string job_path() const { return folder + "/job"; }
  std::string plan_path() const { return folder + "/plan"; }
  std::string scan_path(std::size_t input) const { return folder + "/scan." + std::to_string(input); }
  std::string rows_path(std::size_t input) const { return folder + "/rows." + std::to_string(input); }
  std::string range_path(std::size_t range) const { return folder + "/range." + std::to_string(range); }
  lod::StreamOptions stream_options(lod::Quality quality) const;
};

/// Gaussians of a bin, such that it can be sorted in that memory despite the sample's error.
std::uint64_t choose_bin_rows(const EncodeOptions& encode, int sh_degree, std::uint64_t memory_bytes);

/// Writes the job, creating the folder if needed. The same job again changes nothing; another one is output_exists.
/// With `overwrite` all work begins again: removes the files of the steps, whatever their job, and nothing else. An
/// input with the name of such a file is bad_argument.
Outcome<PartsJob> begin_parts(const PartsRun& run, const PartsJob& job, bool overwrite);
/// Errors: WorkFile's.
Outcome<PartsJob> open_job(const PartsRun& run);
/// The plan, if this version made it from the present scans; none if a scan is missing or newer.
Outcome<std::optional<PartsPlan>> find_plan(const PartsRun& run, const PartsJob& job);

/// True if the step had anything to do.
using Done = Outcome<bool>;
Done scan_input(const PartsRun& run, const PartsJob& job, std::size_t input);
/// Errors: open_failed for a missing scan; those of convert_to_levels() that concern the whole scene.
Done make_plan(const PartsRun& run, const PartsJob& job);
Done place_input(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, std::size_t input);
/// A range without stretches, which occurs if ranges are many, needs no file.
Done build_range(const PartsRun& run, const PartsJob& job, const PartsPlan& plan, std::size_t range);
Outcome<ConvertSummary> assemble_parts(const PartsRun& run, const PartsJob& job, const PartsPlan& plan,
                                       const std::string& output_path, const AtomicFile::Options& output);

/// Where the stretches of all leaves begin, see lod::cut_stretches().
std::vector<std::uint64_t> stretches_of(const PartsRun& run, const PartsJob& job, const PartsPlan& plan);
/// The stretches [first, last) of a range; ranges differ by at most one stretch.
struct StretchRange {
  std::size_t first = 0, last = 0;
};
StretchRange stretches_of_range(std::size_t n_stretches, std::size_t range, std::size_t n_ranges);

/// The inputs or ranges of one process: "all", "none", "K" or "K-M". None if the text is not valid.
struct Selection {
  std::size_t first = 0, last = ~std::size_t{0};  ///< `first` to `last` inclusive; none if last < first
  bool is_part = false;
  std::string text = "all";
};
std::optional<Selection> parse_selection(const std::string& text);

/// The state of the work as JSON: inputs and ranges, and whether each is done; see docs/user/CLUSTER.md.
Outcome<std::string> list_parts(const PartsRun& run);

}  // namespace rgs
