// rgs_convert.hpp - the options of rgs-convert in groups, and its modes. Each group declares its options beside the code
// that they steer; until the command line is parsed it must stay where it is.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "batch.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "convert.hpp"
#include "failure.hpp"
#include "input_declarations.hpp"
#include "parts.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/splat_edit.hpp"
#include "scene_input.hpp"
#include "tile_stream.hpp"

namespace rgs {

/// Groups as --help titles them. What an option concerns follows from its group.
inline constexpr const char* kSceneGroup = "Options";
/// Other outputs reject these and the next group: ignoring them would mislead.
inline constexpr const char* kRgsGroup = "Options for .rgs output";
/// This and the groups below affect no output's bytes.
inline constexpr const char* kLevelsGroup = "Resources of --lod";
inline constexpr const char* kRunGroup = "Writing and reporting";
inline constexpr const char* kBatchGroup = "Many scenes (docs/user/BATCH.md)";
inline constexpr const char* kPartsGroup = "One scene in many processes (docs/user/CLUSTER.md)";

/// Ends parsing with a message for the user.
[[noreturn]] inline void refuse_option(const std::string& message) {
  throw CLI::ParseError(message, CLI::ExitCodes::ValidationError);
}
std::map<std::string, SplatFormat> formats_by_name(bool writable = false);

/// What is read, and how Gaussians are placed and filtered.
struct SceneOptions {
  std::vector<std::string> files;  ///< inputs, then the output
  SplatFormat from = SplatFormat::unknown;
  bool merge = false, skip_unknown_extensions = false;
  Axes spz_axes = kAxes3dgs;
  std::optional<Axes> axes, to_axes;
  std::vector<glm::dvec3> translate;  ///< this and the next two: one for all inputs, or one each
  std::vector<glm::dmat3> rotate;
  std::vector<double> scale;
  SplatFilter filter;
  std::optional<std::uint32_t> level_of_detail;
  AskedDeclarations asked;
  DecodeLimits limits;

  void add_to(CLI::App& app);
  /// The message for the user if options do not fit together.
  std::optional<std::string> check() const;

  const std::string& output() const { return files.back(); }
  std::size_t n_inputs() const { return files.size() - 1; }
  std::span<const std::string> inputs() const { return {files.data(), n_inputs()}; }
  SplatFormat format_of(const SceneInput& input) const;
  bool moves() const { return to_axes || !translate.empty() || !rotate.empty() || !scale.empty(); }
  /// Whether Gaussians are changed or filtered, so that they cannot be streamed.
  bool edits() const { return n_inputs() > 1 || !filter.keeps_all() || moves() || level_of_detail; }
  Similarity placement(std::size_t input) const;
  /// Axes of the output. Formats that prescribe axes get those. An .rgs keeps its source's axes, except those that the
  /// source's format prescribes: such scenes are converted to the frame of 3DGS cameras.
  Axes target_axes(const Axes& source, SplatFormat from_format, SplatFormat to_format) const;
  /// Applies the filter's max_n to the levels of a single input first; of several inputs it would be ambiguous.
  ReadOptions read_options() const;
};

/// Reads, places, merges and filters all inputs. Sets declarations of files that options do not override in `convert`.
Outcome<LoadedScene> load_scene(const SceneOptions& options, ConvertOptions& convert,
                                const std::deque<SceneInput>& inputs, SplatFormat to, DeclaredLoss& loss);

struct InputTile {
  Tile tile;
  InputDeclarations declared;
  SplatFormat format = SplatFormat::unknown;
  std::uint64_t bytes = 0;
  std::vector<std::string> unused;
};
/// Input `i` as a tile with its axes and its placement.
Outcome<InputTile> open_tile(const SceneOptions& options, const SceneInput& input, std::size_t i,
                             std::vector<std::string>& notes);

/// What is written.
struct OutputOptions {
  SplatFormat to = SplatFormat::unknown;
  std::optional<int> spz_version;
  std::optional<BadPolicy> on_bad;
  bool levels = false;
  std::optional<lod::Quality> lod_quality;
  bool on_cuda = false;
  std::optional<std::uint64_t> memory_bytes;
  bool limits_memory = false;  ///< --memory or --scratch are given
  std::string cameras;
  ConvertOptions convert;
  ArchiveTarget target;
  std::string rgs_option;  ///< one that was given and is for .rgs outputs

  void add_to(CLI::App& app);
  std::optional<std::string> check() const;
  std::optional<std::string> check_format(const SceneOptions& scene, SplatFormat format) const;
  SplatFormat format_of(const std::string& output) const {
    return to != SplatFormat::unknown ? to : format_of_name(output);
  }
  /// Completes `convert`, except its cameras.
  void settle(const SceneOptions& scene, int threads);
  Outcome<void> read_cameras();
};

struct RunOptions {
  int threads = 0;  ///< 0: all
  bool json = false, quiet = false;

  void add_to(CLI::App& app);
  unsigned n_threads() const;
  tool::Progress::Mode progress() const {
    return quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic;
  }
  void print_summary(const ConvertSummary& summary, const std::string& output) const;
};

/// The options of every mode.
struct ConvertArguments {
  SceneOptions scene;
  OutputOptions output;
  RunOptions run;
  bool audit = false;
  std::string given;  ///< text of all options that affect an output

  /// The message for the user if options do not fit together; otherwise completes them.
  std::optional<std::string> settle();
  /// Reports an output that is an input. Returns an exit code.
  int check_outputs() const;
};

// What follows prints errors and returns an exit code, except where it returns an Outcome.

/// The inputs of a conversion, and files beside them that are read too: none may change before the output is renamed.
struct OpenInputs {
  std::deque<SceneInput> scenes;
  std::deque<MappedFile> beside;
};
Outcome<OpenInputs> open_inputs(ConvertArguments& arguments);
Outcome<ConvertSummary> convert_open(ConvertArguments& arguments, const std::deque<SceneInput>& inputs,
                                     tool::Progress::Mode mode);
StageObserver observe(tool::Progress& progress);
int report_failure(const Failure& failure);

int convert_one_scene(ConvertArguments& arguments);

/// A folder or a list of scenes.
struct ManyScenes {
  std::string list;
  bool overwrite_damaged = false;
  BatchOptions batch;

  void add_to(CLI::App& app);
  int convert(ConvertArguments& arguments);
};

/// One scene in many processes.
struct SceneInParts {
  std::string step, folder;  ///< the option that chooses the step; empty: another mode
  Selection selection;
  std::uint32_t n_ranges = 0;  ///< 0: not given

  void add_to(CLI::App& app);
  /// `input_list`: names more inputs of --lod-partition.
  int convert(const CLI::App& app, ConvertArguments& arguments, const std::string& input_list) const;
};

/// The formats and what each keeps, in Markdown.
std::string format_table();

/// rgs-audit of a finished conversion, a program of its own: pictures need libraries that a converter should not depend
/// on.
void add_audit(CLI::App& app, bool& audit);
/// "scene.audit.html" for "scene.rgs".
std::string audit_report(const std::string& output);
/// rgs-audit's arguments for the source, this asset, cameras and threads.
std::vector<std::string> audit_options(const ConvertArguments& arguments, const std::string& asset);
/// Finds rgs-audit and checks for `option` that it can compare: it pairs the Gaussians of two files.
int find_auditor(const ConvertArguments& arguments, const std::string& option, std::string& program);
/// Checks before an hour of work that --audit can run.
int check_audit(const ConvertArguments& arguments, std::string& program);
int run_audit(const ConvertArguments& arguments, const std::string& program);

/// Checks --target-psnr, which measures with rgs-audit, and --target-size. Finds the program.
int check_target(const ConvertArguments& arguments, std::string& auditor);
/// Converts with the steps of next_step(), and gives the kept file its name. Without one nothing is written and the code
/// is kGate.
tl::expected<ConvertSummary, int> convert_to_target(ConvertArguments arguments, const std::deque<SceneInput>& inputs,
                                                    const std::string& auditor);

}  // namespace rgs
