// rgs_convert.cpp - rgs-convert: splat files of any format to any other. Arguments and exit codes; convert.hpp,
// batch.hpp and parts.hpp do the work.
// SPDX-License-Identifier: Apache-2.0
#include <sys/resource.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <deque>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include "batch.hpp"
#include "batch_plan.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "convert.hpp"
#include "convert_arguments.hpp"
#include "convert_summary.hpp"
#include "failure.hpp"
#include "input_declarations.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "parts_command.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/version.hpp"
#include "scene_input.hpp"
#include "scratch_file.hpp"
#include "sibling_program.hpp"
#include "spz_axes.hpp"
#include "stage_clock.hpp"
#include "tile_stream.hpp"

namespace {

namespace fs = std::filesystem;
namespace tool = rgs::tool;
using Input = rgs::SceneInput;
using rgs::failed;
using rgs::Failure;
using rgs::Outcome;
using rgs::SplatFormat;

struct ArchiveChanges {
  std::optional<int> mean_cells, opacity_levels;
  std::optional<float> sh_step, dc_step, rotation_step, scale_step, slope;
};

struct Arguments {
  std::vector<std::string> files;   // inputs, then the output
  std::string list, report, shard;  // of many scenes
  unsigned jobs = 1;
  bool keep_going = true, stop = false, overwrite_damaged = false;
  std::string given;  // text of all options that affect an output, and the cameras' contents
  std::string cameras, axes = "3dgs", to_axes, crop, max_count;
  rgs::Axes spz_axes = rgs::kAxes3dgs;
  std::optional<std::uint32_t> level_of_detail;
  std::optional<rgs::lod::Quality> lod_quality;
  bool lod = false;
  std::vector<std::string> translate, rotate, scale;  // one for all inputs, or one each
  SplatFormat from = SplatFormat::unknown, to = SplatFormat::unknown;
  rgs::ConvertOptions convert;
  rgs::ArchiveOptions archive;  // of the preset
  ArchiveChanges archive_changes;
  rgs::SplatFilter filter;
  rgs::AskedDeclarations asked;
  rgs::DecodeLimits limits;
  bool merge = false, axes_given = false, to_axes_given = false;
  bool keep_order = false, explicit_policy = false, no_sync = false, json = false, quiet = false;
  bool file_scales = false, audit = false, spz_version_given = false, skip_unknown_extensions = false,
       memory_given = false;
  int threads = 0;
  const char* rgs_option = nullptr;  // one that was given, see kRgsOptions
  rgs::PartsCommand parts;

  const std::string& output() const { return files.back(); }
  std::size_t n_inputs() const { return files.size() - 1; }
};

// Options that affect .rgs files alone. Other outputs reject them: ignoring them would mislead.
constexpr const char* kRgsOptions[] = {"--profile",
                                       "--level",
                                       "--keep-permutation",
                                       "--chunk-size",
                                       "--file-scales",
                                       "--lod",
                                       "--lod-quality",
                                       "--memory",
                                       "--scratch",
                                       "--cameras",
                                       "--near",
                                       "--far",
                                       "--depth-map",
                                       "--audit",
                                       "--archive-mean-cells",
                                       "--archive-sh-step",
                                       "--archive-dc-step",
                                       "--archive-rotation-step",
                                       "--archive-scale-step",
                                       "--archive-opacity-levels",
                                       "--archive-slope"};

rgs::StageObserver observe(tool::Progress& progress) {
  rgs::StageObserver observer;
  observer.begin = [&progress](const char* stage, std::uint64_t total, const char* unit) {
    progress.begin(stage, total, unit);
  };
  observer.advance = [&progress](std::uint64_t units) { progress.advance(units); };
  observer.finish = [&progress] { progress.finish(); };
  return observer;
}

bool concerns_output(rgs::Errc code) {
  using rgs::Errc;
  return code == Errc::write_failed || code == Errc::output_exists || code == Errc::output_unusable;
}

// Truncated parts of a mapped input read as zeros, so a change of the file explains any other error.
Failure explained(Failure failure, const std::deque<Input>& inputs) {
  if (concerns_output(failure.error.code)) return failure;
  for (const Input& input : inputs) {
    if (const rgs::Status s = input.file().check_unchanged(); !s) return {input.path(), s.error()};
  }
  return failure;
}

// Axes of the output. Formats that prescribe axes get those. An .rgs keeps its source's axes, except those that the
// source's format prescribes: such scenes are converted to the frame of 3DGS cameras.
rgs::Axes target_axes(const Arguments& arguments, const rgs::Axes& axes, SplatFormat from, SplatFormat to) {
  const bool undeclared = axes[0] == rgs::Axis::undeclared && arguments.n_inputs() == 1;
  if (undeclared && !arguments.to_axes_given) return axes;  // nothing to convert
  if (to == SplatFormat::spz) return arguments.spz_axes;
  if (to == SplatFormat::glb) return rgs::format_axes(to);
  if (arguments.to_axes_given) return rgs::parse_axes(arguments.to_axes).value();
  const bool prescribed = from == SplatFormat::spz || from == SplatFormat::glb;
  return to == SplatFormat::rgs && (!prescribed || arguments.axes_given) ? axes : rgs::kAxes3dgs;
}

const std::string& of_input(const std::vector<std::string>& texts, std::size_t input) {
  static const std::string kNone;
  return texts.empty() ? kNone : texts[texts.size() == 1 ? 0 : input];
}

bool moves(const Arguments& arguments) {
  return arguments.to_axes_given || !arguments.translate.empty() || !arguments.rotate.empty() ||
         !arguments.scale.empty();
}

// Whether Gaussians are changed or filtered, so that they cannot be streamed.
bool edits(const Arguments& arguments) {
  return arguments.n_inputs() > 1 || !arguments.filter.keeps_all() || moves(arguments) || arguments.level_of_detail;
}

// Applies max_count to the levels of a single input first; of several inputs it would be ambiguous.
rgs::ReadOptions read_options(const Arguments& arguments) {
  rgs::ReadOptions options;
  options.limits = arguments.limits;
  options.format = arguments.from;
  options.skip_unknown_extensions = arguments.skip_unknown_extensions;
  options.spz_axes = arguments.spz_axes;
  options.level_of_detail = arguments.level_of_detail;
  if (arguments.n_inputs() == 1 && !arguments.max_count.empty() && !arguments.level_of_detail)
    options.max_count = arguments.filter.max_n;
  return options;
}

// Converts an input to these axes and places it; returns the placement.
rgs::Similarity place(const Arguments& arguments, std::size_t input, const rgs::Axes& axes, rgs::SplatFile& file) {
  rgs::convert_axes(file.cloud, file.axes, axes);
  rgs::convert_axes(file.origin, file.axes, axes);
  const rgs::Similarity placed =
      rgs::parse_similarity(of_input(arguments.translate, input), of_input(arguments.rotate, input),
                            of_input(arguments.scale, input))
          .value();
  rgs::transform_splats(file.cloud, file.origin, placed);
  return placed;
}

// How to read an input. Gaussians that other filters drop do not count towards max_count.
rgs::Result<rgs::ReadOptions> read_options(const Arguments& arguments, const Input& input, SplatFormat to) {
  rgs::ReadOptions options = read_options(arguments);
  rgs::SplatFilter others = arguments.filter;
  others.max_n = rgs::SplatFilter().max_n;
  if (!options.max_count || others.keeps_all()) return options;
  auto counts = input.count_in_pages(options.limits, [&](rgs::SplatFile some) {
    if (arguments.axes_given) some.axes = rgs::parse_axes(arguments.axes).value();
    place(arguments, 0, target_axes(arguments, some.axes, SplatFormat::rgs, to), some);
    return rgs::filter_splats(some.cloud, others, some.origin);
  });
  if (!counts) return tl::unexpected(counts.error());
  options.page_counts = std::move(*counts);
  return options;
}

// The axes of an SPZ, and why: the format leaves them open.
void note_spz_axes(const Arguments& arguments, const Input& input, const rgs::SplatFile& file,
                   std::vector<std::string>& notes) {
  if (file.format != SplatFormat::spz || arguments.axes_given) return;
  notes.push_back("the axes of " + tool::printable(input.name()) + " are " + rgs::axes_text(file.axes) +
                  (file.axes_assumed ? ", assumed because it declares none (--spz-axes)" : ", as it declares"));
}

// Reads, places, merges and filters all inputs. Sets declarations of files that options do not override.
Outcome<rgs::LoadedScene> load_scene(Arguments& arguments, std::deque<Input>& inputs, SplatFormat to,
                                     rgs::DeclaredLoss& loss) {
  rgs::LoadedScene scene;
  rgs::EncodeOptions& encode = arguments.convert.encode;
  std::vector<std::uint64_t> hashes;
  std::vector<rgs::InputDeclarations> declared;
  std::vector<rgs::ScenePart> parts;
  rgs::SplatFile only;  // without its Gaussians
  for (std::size_t i = 0; i < inputs.size(); ++i) {
    auto options = read_options(arguments, inputs[i], to);
    if (!options) return failed(inputs[i].path(), options.error());
    auto file = inputs[i].read(std::move(*options));
    if (!file) return failed(inputs[i].path(), file.error());
    note_spz_axes(arguments, inputs[i], *file, loss.notes);
    if (arguments.axes_given) file->axes = rgs::parse_axes(arguments.axes).value();
    if (i == 0) encode.axes = target_axes(arguments, file->axes, file->format, to);
    scene.format = i == 0 ? rgs::format_name(file->format) : "merged";
    scene.bytes += file->bytes;
    scene.n_source += file->cloud.size();
    scene.source_sh_degree = std::max(scene.source_sh_degree, file->cloud.sh_degree);
    hashes.push_back(inputs[i].hash());
    scene.unused.insert(scene.unused.end(), file->unused.begin(), file->unused.end());
    const rgs::Similarity placed = place(arguments, i, encode.axes, *file);
    declared.push_back(rgs::declared_by(*file, inputs[i].name(), placed.scale));
    if (to != SplatFormat::rgs) rgs::restore_order(*file);
    parts.push_back({file->cloud.size(), file->origin, file->position_rounding * placed.scale});
    if (i == 0) {
      scene.cloud = std::move(file->cloud);
      if (inputs.size() == 1) only = std::move(*file);
    } else {
      rgs::append_splats(scene.cloud, file->cloud);
    }
  }
  if (auto s = rgs::declare_scene(encode, declared, arguments.asked, loss.notes); !s)
    return failed(inputs.front().path(), s.error());
  rgs::merge_parts(scene.cloud, parts, scene.origin);
  const double max_rounding = rgs::max_rounding(encode, arguments.convert.allow_rounding);
  for (std::size_t i = 0; i < parts.size(); ++i) {
    scene.position_rounding = std::max(scene.position_rounding, parts[i].position_rounding);
    if (auto s = rgs::check_rounding(parts[i].position_rounding, max_rounding); !s)
      return failed(inputs[i].path(), s.error());
  }
  const std::vector<std::uint64_t> kept = rgs::filter_splats(scene.cloud, arguments.filter, scene.origin);
  scene.xxh3 = rgs::hash_of_sources(hashes);
  if (!rgs::keep_source(encode, scene, only, kept, moves(arguments))) {
    loss.notes.push_back("positions refer to " + inputs.front().name() +
                         ", which does not hold positions in its own source (--keep-permutation)");
  }
  if (to == SplatFormat::spz)
    loss.notes.push_back("the output's axes are " + rgs::axes_text(encode.axes) +
                         ", which the SPZ does not state (--spz-axes)");
  if (to == SplatFormat::rgs && !only.source_index.empty() && !encode.keep_permutation)
    loss.lost.emplace_back("positions in the source (--keep-permutation keeps them)");
  return scene;
}

SplatFormat format_of_input(const Arguments& arguments, const Input& input) {
  return arguments.from != SplatFormat::unknown ? arguments.from : rgs::detect_format(input.bytes());
}

// Whether levels are built from tiles, so that inputs are not in memory together: several, or one PLY. Filters need all
// Gaussians in memory, and so does a single .rgs, which may name a source of its own.
bool streams_tiles(const Arguments& arguments, const std::deque<Input>& inputs, SplatFormat to) {
  return to == SplatFormat::rgs && arguments.lod && arguments.filter.keeps_all() && !arguments.level_of_detail &&
         (inputs.size() > 1 || format_of_input(arguments, inputs.front()) == SplatFormat::ply);
}

// The file, or the folder of scratch files, that an error is about.
std::string concerned(const Arguments& arguments, const Input& input, const rgs::Error& error) {
  if (!rgs::lod::concerns_scratch(error)) return concerns_output(error.code) ? arguments.output() : input.path();
  return arguments.convert.scratch.empty() ? "." : arguments.convert.scratch;
}

struct InputTile {
  rgs::Tile tile;
  rgs::InputDeclarations declared;
  SplatFormat format = SplatFormat::unknown;
  std::uint64_t bytes = 0;
  std::vector<std::string> unused;
};

Outcome<InputTile> open_tile(const Arguments& arguments, const Input& input, std::size_t i,
                             std::vector<std::string>& notes) {
  InputTile out;
  out.format = format_of_input(arguments, input);
  auto tile = input.tile(out.format, read_options(arguments));
  if (!tile) return failed(input.path(), tile.error());
  out.tile = std::move(*tile);
  out.tile.placed = rgs::parse_similarity(of_input(arguments.translate, i), of_input(arguments.rotate, i),
                                          of_input(arguments.scale, i))
                        .value();
  if (out.tile.ply) {
    out.tile.axes = out.tile.ply->declarations().axes;
    out.declared = rgs::declared_by(*out.tile.ply, input.name(), out.tile.placed.scale);
    out.bytes = input.bytes().size();
  } else {
    const auto file = out.tile.load();
    if (!file) return failed(input.path(), file.error());
    out.tile.axes = file->axes;
    out.format = file->format;
    out.bytes = file->bytes;
    out.unused = file->unused;
    note_spz_axes(arguments, input, *file, notes);
    out.declared = rgs::declared_by(*file, input.name(), out.tile.placed.scale);
  }
  if (arguments.axes_given) out.tile.axes = rgs::parse_axes(arguments.axes).value();
  return out;
}

// Equals load_scene() and convert_scene(), tile by tile.
Outcome<rgs::ConvertSummary> convert_tiles(Arguments& arguments, std::deque<Input>& inputs, rgs::DeclaredLoss& loss,
                                           const rgs::StageObserver& observer) {
  rgs::EncodeOptions& encode = arguments.convert.encode;
  std::vector<rgs::Tile> tiles(inputs.size());
  std::vector<rgs::InputDeclarations> declared;
  std::vector<std::string> unused;
  std::uint64_t bytes = 0;
  SplatFormat first_format = SplatFormat::unknown;
  for (std::size_t i = 0; i < inputs.size(); ++i) {
    auto opened = open_tile(arguments, inputs[i], i, loss.notes);
    if (!opened) return tl::unexpected(opened.error());
    if (i == 0) first_format = opened->format;
    if (i == 0) encode.axes = target_axes(arguments, opened->tile.axes, opened->format, SplatFormat::rgs);
    bytes += opened->bytes;
    unused.insert(unused.end(), opened->unused.begin(), opened->unused.end());
    declared.push_back(std::move(opened->declared));
    tiles[i] = std::move(opened->tile);
  }
  std::size_t tile = 0;
  const auto scene = rgs::TileStream::open(std::move(tiles), encode.axes, tile);
  if (!scene) return failed(inputs[tile].path(), scene.error());
  if (auto s = rgs::declare_scene(encode, declared, arguments.asked, loss.notes); !s)
    return failed(inputs.front().path(), s.error());
  encode.n_source = scene->size();
  encode.n_repaired = 0;
  rgs::StreamFacts facts;
  facts.bytes = bytes;
  facts.origin = scene->origin();
  facts.hash = [&inputs] {
    std::vector<std::uint64_t> hashes;
    for (const Input& input : inputs) hashes.push_back(input.hash());
    return rgs::hash_of_sources(hashes);
  };
  auto summary = rgs::convert_to_levels(scene->stream(rgs::max_rounding(encode, arguments.convert.allow_rounding)),
                                        facts, arguments.output(), arguments.convert, observer);
  if (!summary) return failed(concerned(arguments, inputs[scene->reading()], summary.error()), summary.error());
  summary->source_format = inputs.size() == 1 ? rgs::format_name(first_format) : "merged";
  summary->position_rounding = scene->position_rounding();
  summary->unused = std::move(unused);
  summary->notes = std::move(loss.notes);
  return std::move(*summary);
}

Outcome<rgs::ConvertSummary> convert(Arguments& arguments, std::deque<Input>& inputs, SplatFormat to,
                                     const rgs::StageObserver& observer) {
  const Input& first = inputs.front();
  const SplatFormat from = format_of_input(arguments, first);
  const auto outcome = [&](rgs::Result<rgs::ConvertSummary> summary) -> Outcome<rgs::ConvertSummary> {
    if (summary) return std::move(*summary);
    return failed(concerned(arguments, first, summary.error()), summary.error());
  };
  rgs::DeclaredLoss loss;
  const auto declare = [&](const rgs::InputDeclarations& by_input) {
    return rgs::declare_scene(arguments.convert.encode, {&by_input, 1}, arguments.asked, loss.notes);
  };
  if (from == SplatFormat::ply && to == SplatFormat::rgs && !edits(arguments)) {
    const auto ply = rgs::PlyFile::open(first.bytes());
    if (!ply) return failed(first.path(), ply.error());
    if (!arguments.axes_given) arguments.convert.encode.axes = ply->declarations().axes;
    if (auto s = declare(rgs::declared_by(*ply, first.name())); !s) return failed(first.path(), s.error());
    return outcome(rgs::convert_to_rgs(*ply, arguments.output(), arguments.convert, observer));
  }
  if (from == SplatFormat::rgs && to == SplatFormat::ply && !edits(arguments) && !rgs::has_levels(first.bytes())) {
    const auto view = rgs::FileView::open(first.bytes(), arguments.limits);
    if (!view) return failed(first.path(), view.error());
    const rgs::Axes& axes = view->declarations().axes;
    const bool as_is = axes == rgs::kAxes3dgs || axes[0] == rgs::Axis::undeclared;
    if (as_is && !arguments.axes_given && view->header().sh_degree <= arguments.convert.encode.sh_degree) {
      if (auto s = declare(rgs::declared_by(*view, first.name())); !s) return failed(first.path(), s.error());
      rgs::EncodeOptions encode = arguments.convert.encode;
      encode.axes = axes;
      return outcome(rgs::convert_rgs_to_ply(*view, arguments.output(), arguments.convert.output, observer,
                                             rgs::stated_by(encode, view->declarations())));
    }
  }
  if (streams_tiles(arguments, inputs, to)) return convert_tiles(arguments, inputs, loss, observer);
  std::vector<std::pair<const char*, double>> seconds;
  rgs::StageClock clock(observer, seconds);
  clock.begin("read", 0, "");
  auto scene = load_scene(arguments, inputs, to, loss);
  if (!scene) return tl::unexpected(scene.error());
  clock.end();
  auto summary = rgs::convert_scene(std::move(*scene), to, arguments.output(), arguments.convert, observer);
  if (summary) {
    summary->seconds.insert(summary->seconds.begin(), seconds.begin(), seconds.end());
    summary->lost.insert(summary->lost.end(), loss.lost.begin(), loss.lost.end());
    summary->notes = std::move(loss.notes);
  }
  return outcome(std::move(summary));
}

// Parses and checks options; returns the message for the user if something is wrong.
std::optional<std::string> check_arguments(Arguments& a) {
  const auto text = [](const rgs::Error& error) { return std::string(error.what); };
  for (const std::string* axes : {&a.axes, &a.to_axes}) {
    if (axes->empty()) continue;
    if (const auto parsed = rgs::parse_axes(*axes); !parsed) return text(parsed.error());
  }
  if (a.lod_quality && !a.lod) return "--lod-quality requires --lod";
  if (!a.lod && a.convert.memory_bytes != rgs::lod::kDefaultMemory) return "--memory requires --lod";
  if (!a.lod && !a.convert.scratch.empty()) return "--scratch requires --lod";
  if (a.convert.memory_bytes < rgs::lod::kLeastMemory) return "--memory must be at least 128MiB";
  if (a.lod) a.convert.levels = a.lod_quality.value_or(rgs::lod::Quality::fast);
  if (a.convert.scratch.empty() && a.output() != "-")
    a.convert.scratch = std::filesystem::path(a.output()).parent_path().string();
  if (a.n_inputs() > 1 && !a.merge) return "several inputs require --merge";
  for (const auto* texts : {&a.translate, &a.rotate, &a.scale}) {
    if (texts->size() > 1 && texts->size() != a.n_inputs()) {
      return "give --translate, --rotate and --scale once for all inputs or once for each";
    }
  }
  for (std::size_t i = 0; i < a.n_inputs(); ++i) {
    const auto placed = rgs::parse_similarity(of_input(a.translate, i), of_input(a.rotate, i), of_input(a.scale, i));
    if (!placed) return text(placed.error());
  }
  if (!a.crop.empty()) {
    const auto box = rgs::parse_box(a.crop);
    if (!box) return text(box.error());
    a.filter.crop = *box;
  }
  if (!a.max_count.empty()) {
    const auto count = tool::parse_count(a.max_count);
    if (!count) return "--max-count: " + text(count.error());
    a.filter.max_n = *count;
  }
  if (a.asked.aa_mode == rgs::AaMode::undeclared && a.asked.low_pass_px2)
    return "--low-pass requires --aa classic or mip-splatting";
  if (a.json && a.output() == "-") return "--json and output - both need standard output";
  if (std::count(a.files.begin(), a.files.end() - 1, "-") > 1) return "only one input can be standard input";
  return std::nullopt;
}

// Path of rgs-audit's report: "scene.audit.html" for "scene.rgs".
std::string report_path(const std::string& output) {
  return std::filesystem::path(output).replace_extension(".audit.html").string();
}

// Checks before an hour of work that the audit can run: it pairs the Gaussians of two files, and is a program of its
// own.
int check_audit(const Arguments& arguments, const Input& input, std::string& program) {
  if (!arguments.audit) return tool::kSuccess;
  if (input.path() == "-" || arguments.output() == "-")
    return tool::report_usage("--audit compares two files; name files instead of -");
  if (arguments.n_inputs() > 1 || arguments.level_of_detail)
    return tool::report_usage("--audit compares an .rgs with all Gaussians of one source file");
  if (moves(arguments))
    return tool::report_usage(
        "--audit requires Gaussians to stay where the source has them; drop the options that move them");
  const auto found = tool::sibling_program("rgs-audit");
  if (!found) return tool::report("rgs-audit", found.error());
  program = *found;
  std::error_code ignored;
  const std::string report = report_path(arguments.output());
  if (!arguments.convert.output.overwrite && std::filesystem::exists(report, ignored))
    return tool::report(
        report, {rgs::Errc::output_exists, rgs::Error::kNone, "the report exists; pass --overwrite to replace it"});
  return tool::kSuccess;
}

// A separate program, because pictures need libraries that a converter should not depend on.
int run_audit(const Arguments& arguments, const std::string& program) {
  std::vector<std::string> options{arguments.files.front(), arguments.output(), "--report",
                                   report_path(arguments.output())};
  if (!arguments.cameras.empty()) options.insert(options.end(), {"--cameras", arguments.cameras});
  if (arguments.spz_axes == rgs::kAxesOpenGl) options.insert(options.end(), {"--spz-axes", "opengl"});
  if (arguments.convert.output.overwrite) options.emplace_back("--overwrite");
  if (arguments.threads > 0) options.insert(options.end(), {"--threads", std::to_string(arguments.threads)});
  if (arguments.quiet || arguments.json) options.emplace_back("--quiet");
  const auto code = tool::run_program_and_wait(program, options);
  return code ? *code : tool::report(program, code.error());
}

rgs::ArchiveOptions archive_options(const Arguments& a) {
  rgs::ArchiveOptions o = a.archive;
  const ArchiveChanges& c = a.archive_changes;
  o.mean_cells = c.mean_cells.value_or(o.mean_cells);
  o.sh_step = c.sh_step.value_or(o.sh_step);
  o.dc_step = c.dc_step.value_or(o.dc_step);
  o.rotation_step = c.rotation_step.value_or(o.rotation_step);
  o.scale_step = c.scale_step.value_or(o.scale_step);
  o.opacity_levels = c.opacity_levels.value_or(o.opacity_levels);
  o.slope = c.slope.value_or(o.slope);
  return o;
}

int check_outputs(const Arguments& a) {
  tool::InputFiles inputs;
  for (std::size_t i = 0; i < a.n_inputs(); ++i) inputs.add_scene(a.files[i]);
  inputs.add_cameras(a.cameras);
  const bool prints = a.output() != "-" && (a.json || !a.quiet);
  const std::array<std::string, 3> outputs{a.output(), a.audit ? report_path(a.output()) : "", prints ? "-" : ""};
  return inputs.check_outputs(outputs);
}

// Raises the limit on open files: inputs stay open until the output is renamed.
void allow_open_files(std::size_t n) {
  constexpr std::size_t kOthers = 64;  // output, scratch files, files beside an input
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit) != 0 || limit.rlim_cur >= n + kOthers) return;
  limit.rlim_cur = std::min<rlim_t>(limit.rlim_max, n + kOthers);
  (void)::setrlimit(RLIMIT_NOFILE, &limit);  // on failure, opening reports the file
}

// Opens the inputs, and into `beside` files beside them that are read too: none may change before the output is
// renamed.
Outcome<void> open_inputs(Arguments& a, std::deque<Input>& inputs, std::deque<rgs::MappedFile>& beside) {
  tool::InputFiles scenes;
  allow_open_files(a.n_inputs());
  for (std::size_t i = 0; i < a.n_inputs(); ++i) {
    scenes.add_scene(a.files[i]);
    if (const rgs::Status s = inputs.emplace_back().open(a.files[i]); !s) return failed(a.files[i], s.error());
    a.convert.output.inputs.push_back(&inputs.back().file());
  }
  for (const std::string& path : scenes.paths()) {
    if (std::find(a.files.begin(), a.files.end() - 1, path) != a.files.end() - 1) continue;
    auto file = rgs::MappedFile::open(path);
    if (!file) return failed(path, file.error());
    a.convert.output.inputs.push_back(&beside.emplace_back(std::move(*file)));
  }
  return {};
}

void settle_options(Arguments& arguments) {
  rgs::EncodeOptions& encode = arguments.convert.encode;
  encode.axes = rgs::parse_axes(arguments.axes).value();
  encode.order = arguments.keep_order ? rgs::Order::input : rgs::Order::morton;
  encode.chunk_step_sets = !arguments.file_scales;
  encode.archive = archive_options(arguments);
  encode.archive.threads = static_cast<unsigned>(arguments.threads);
  if (arguments.explicit_policy) encode.max_bad_fraction = 1;
  if (arguments.convert.strict) encode.on_bad = rgs::BadPolicy::refuse;
  arguments.convert.output.sync = !arguments.no_sync;
}

// Checks options against the output's format; returns the message for the user if they do not fit.
std::optional<std::string> check_format(const Arguments& arguments, SplatFormat to) {
  if (to == SplatFormat::unknown) return "cannot tell the output's format from its name; pass --to rgs, ply, spz, ...";
  if (to != SplatFormat::rgs && !rgs::is_writable(to))
    return std::string("the format ") + rgs::format_name(to) + " is read only";
  if (to != SplatFormat::rgs && arguments.rgs_option != nullptr)
    return std::string(arguments.rgs_option) + " is for .rgs outputs";
  if (to != SplatFormat::spz && arguments.spz_version_given) return "--spz-version is for .spz outputs";
  if (to == SplatFormat::glb && arguments.to_axes_given) return "the axes of glb are prescribed by the format";
  if (to == SplatFormat::spz && arguments.to_axes_given) return "--spz-axes chooses the axes of .spz outputs";
  return std::nullopt;
}

SplatFormat output_format(const Arguments& arguments) {
  return arguments.to != SplatFormat::unknown ? arguments.to : rgs::format_of_name(arguments.output());
}

unsigned n_threads(const Arguments& arguments) {
  return arguments.threads > 0 ? static_cast<unsigned>(arguments.threads)
                               : std::max(1u, std::thread::hardware_concurrency());
}

Outcome<rgs::ConvertSummary> convert_open(Arguments& arguments, std::deque<Input>& inputs,
                                          const rgs::StageObserver& observer) {
  std::uint64_t source_bytes = 0;
  for (const Input& input : inputs) source_bytes += input.bytes().size();
  const std::string name = inputs.size() == 1 ? inputs.front().name() : inputs.front().name() + " and more";
  arguments.convert.encode.provenance = rgs::Provenance{source_bytes, 0, name, "rgs-convert " RGS_VERSION};
  auto summary = convert(arguments, inputs, output_format(arguments), observer);
  if (!summary) return tl::unexpected(explained(std::move(summary.error()), inputs));
  summary->source_name = name;
  rgs::note_rounding(*summary);
  return summary;
}

Outcome<void> read_cameras(Arguments& arguments) {
  if (arguments.cameras.empty()) return {};
  auto cameras = rgs::read_cameras(arguments.cameras);
  if (!cameras) return failed(arguments.cameras, cameras.error());
  arguments.convert.cameras = std::move(*cameras);
  return {};
}

int report_failure(const Failure& failure) {
  return tool::report(failure.file, failure.error);
}

int convert_main(Arguments& arguments) {
  if (const auto message = check_arguments(arguments)) return tool::report_usage(*message);
  settle_options(arguments);
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, n_threads(arguments));
  if (const int code = check_outputs(arguments); code != tool::kSuccess) return code;
  std::deque<Input> inputs;
  std::deque<rgs::MappedFile> beside;
  if (const auto opened = open_inputs(arguments, inputs, beside); !opened) return report_failure(opened.error());
  if (const auto message = check_format(arguments, output_format(arguments))) return tool::report_usage(*message);
  std::string auditor;
  if (const int code = check_audit(arguments, inputs.front(), auditor); code != tool::kSuccess) return code;
  if (const auto read = read_cameras(arguments); !read) return report_failure(read.error());

  Outcome<rgs::ConvertSummary> summary;
  {
    tool::Progress progress(arguments.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    summary = convert_open(arguments, inputs, observe(progress));
  }
  if (!summary) return report_failure(summary.error());
  if (arguments.json) {
    tool::print(rgs::summary_json(*summary));
  } else if (!arguments.quiet) {
    (arguments.output() == "-" ? tool::print_error : tool::print)(rgs::summary_text(*summary));
  }
  if (!arguments.audit) return tool::kSuccess;
  tool::flush();  // before the other program prints
  return run_audit(arguments, auditor);
}

// ---- one scene in many processes

// The job for these inputs and options; opens one file at a time.
Outcome<rgs::PartsJob> describe_job(Arguments& arguments, const std::string& cameras_hash) {
  rgs::PartsJob job;
  rgs::EncodeOptions& encode = arguments.convert.encode;
  std::vector<rgs::InputDeclarations> declared;
  std::vector<rgs::Origin> origins;
  std::uint64_t file_bytes = 0;
  for (std::size_t i = 0; i < arguments.n_inputs(); ++i) {
    rgs::PartsInput& part = job.inputs.emplace_back();
    Input input;
    if (const rgs::Status s = input.open(arguments.files[i]); !s) return failed(arguments.files[i], s.error());
    auto opened = open_tile(arguments, input, i, job.notes);
    if (!opened) return tl::unexpected(opened.error());
    if (i == 0) encode.axes = target_axes(arguments, opened->tile.axes, opened->format, SplatFormat::rgs);
    const auto facts = rgs::tile_facts(opened->tile, encode.axes);
    if (!facts) return failed(input.path(), facts.error());
    std::error_code ignored;
    part = {fs::absolute(input.path(), ignored).string(),
            input.name(),
            input.bytes().size(),
            rgs::hash_of_prefix(input.bytes()),
            opened->format,
            opened->tile.axes,
            opened->tile.placed,
            *facts,
            job.n};
    job.n += facts->n;
    job.sh_degree = std::max(job.sh_degree, facts->sh_degree);
    if (facts->n != 0) origins.push_back(facts->origin);
    file_bytes += input.bytes().size();
    job.unused.insert(job.unused.end(), opened->unused.begin(), opened->unused.end());
    declared.push_back(std::move(opened->declared));
  }
  encode.origin = rgs::merged_origin(origins);
  const std::string& first = arguments.files.front();
  if (job.inputs.size() == 1 && job.inputs.front().format == SplatFormat::rgs) {
    return failed(first, {rgs::Errc::bad_argument, rgs::Error::kNone,
                          "a single .rgs is converted in one process; run rgs-convert --lod", rgs::Error::kNone,
                          rgs::Error::kNone, 0});
  }
  if (const rgs::Status s = rgs::check_count(job.n); !s) return failed(first, s.error());
  if (auto s = rgs::declare_scene(encode, declared, arguments.asked, job.notes); !s) return failed(first, s.error());
  const std::string name = job.inputs.front().name + (job.inputs.size() == 1 ? "" : " and more");
  encode.provenance = rgs::Provenance{file_bytes, 0, name, "rgs-convert " RGS_VERSION};
  encode.n_source = job.n;
  encode.n_repaired = 0;
  if (const rgs::Status s = rgs::check_encodable(rgs::SceneScan(0), encode); !s) return failed(first, s.error());
  job.source_format = job.inputs.size() == 1 ? rgs::format_name(job.inputs.front().format) : "merged";
  job.read = read_options(arguments);
  job.encode = encode;
  job.quality = *arguments.convert.levels;
  job.n_ranges = arguments.parts.n_ranges;
  job.bin_rows = rgs::choose_bin_rows(encode, job.output_degree(), arguments.convert.memory_bytes);
  std::error_code ignored;
  if (!arguments.cameras.empty()) job.cameras = fs::absolute(arguments.cameras, ignored).string();
  job.cameras_hash = cameras_hash;
  job.z_near = arguments.convert.z_near;
  job.z_far = arguments.convert.z_far;
  job.strict = arguments.convert.strict;
  job.allow_rounding = arguments.convert.allow_rounding;
  return job;
}

// Options for many scenes. None affects an output.
constexpr std::string_view kBatchOptions[] = {
    "--list", "--jobs", "--shard", "--keep-going", "--no-keep-going", "--report", "--overwrite-damaged"};

// Rejects what parts cannot do; returns the message for the user.
std::optional<std::string> check_parts(const Arguments& a) {
  if (!a.parts.partition.empty() && a.n_inputs() > 0) {
    if (a.parts.n_ranges == 0)
      return "--lod-partition with inputs requires --ranges N, the number of processes that may build";
    if (a.convert.encode.profile == rgs::Profile::archive)
      return "--profile archive needs all Gaussians at once; convert in one process with --lod, or choose packed";
    if (a.keep_order) return "parts are ranges of the Morton curve; --keep-order requires one process with --lod";
    if (!a.filter.keeps_all() || !a.crop.empty() || !a.max_count.empty() || a.level_of_detail)
      return "--crop, --min-opacity, --max-count and --level-of-detail need all Gaussians in memory; apply them "
             "before";
    if (a.audit) return "--audit compares two files; run rgs-audit afterwards";
    if (std::find(a.files.begin(), a.files.end() - 1, "-") != a.files.end() - 1)
      return "several processes read the inputs; name files instead of -";
    return std::nullopt;
  }
  if (!a.given.empty() || !a.cameras.empty() || a.parts.n_ranges != 0)
    return "the work keeps the options that it began with; give them to --lod-partition together with the "
           "inputs";
  if (!a.parts.assemble.empty() && a.files.size() != 1) return "--lod-assemble FOLDER takes one output";
  if (a.parts.assemble.empty() && !a.parts.partition.empty() && a.parts.overwrite)
    return "--overwrite begins again; it requires the inputs";
  if (a.parts.assemble.empty() && a.parts.partition.empty() && !a.files.empty())
    return "the folder of the work suffices; drop " + a.files.front();
  if (a.convert.memory_bytes < rgs::lod::kLeastMemory) return "--memory must be at least 128MiB";
  return std::nullopt;
}

// Rejects an option that the command would ignore; returns the message for the user.
std::optional<std::string> check_parts_options(const CLI::App& app, const rgs::PartsCommand& parts) {
  const char* const command = !parts.partition.empty()  ? "--lod-partition"
                              : !parts.build.empty()    ? "--lod-build"
                              : !parts.assemble.empty() ? "--lod-assemble"
                                                        : "--lod-list";
  const auto has_effect = [&](std::string_view option) {
    if (option == "--list") return !parts.partition.empty();
    if (option == "--json") return !parts.assemble.empty() || !parts.list.empty();
    if (option == "--overwrite") return !parts.assemble.empty() || !parts.partition.empty();
    if (option == "--lod-input") return !parts.partition.empty() || !parts.build.empty();
    return std::ranges::find(kBatchOptions, option) == std::end(kBatchOptions);
  };
  for (const CLI::Option* option : app.get_options()) {
    if (option->count() != 0 && !has_effect(option->get_name()))
      return option->get_name() + " has no effect on " + command;
  }
  return std::nullopt;
}

int convert_parts(Arguments& a) {
  rgs::PartsCommand& parts = a.parts;
  parts.overwrite = a.convert.output.overwrite;
  parts.json = a.json;
  parts.quiet = a.quiet;
  if (!parts.partition.empty() && !a.list.empty()) {
    const auto lines = rgs::lines_of(a.list);
    if (!lines) return tool::report(a.list, lines.error());
    std::ranges::copy_if(*lines, std::back_inserter(a.files), [](const std::string& line) { return !line.empty(); });
    if (a.files.empty()) return tool::report_usage("no input is named in " + a.list);
  }
  const bool begins = !parts.partition.empty() && !a.files.empty();
  if (!parts.partition.empty()) a.files.push_back(parts.partition + "/job");
  if (const auto message = check_parts(a)) return tool::report_usage(*message);
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, n_threads(a));
  std::function<Outcome<rgs::PartsJob>()> describe;
  std::string cameras_hash;
  if (begins) {
    a.lod = a.merge = true;
    if (const auto message = check_arguments(a)) return tool::report_usage(*message);
    settle_options(a);
    if (const int code = check_outputs(a); code != tool::kSuccess) return code;
    const auto hash = rgs::options_hash({}, a.cameras);  // all other options are in the job itself
    if (!hash) return tool::report(a.cameras, hash.error());
    cameras_hash = *hash;
    describe = [&] { return describe_job(a, cameras_hash); };
  }
  tool::Progress progress(a.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
  rgs::PartsRun run;
  run.folder = parts.folder();
  run.memory_bytes = a.convert.memory_bytes;
  run.scratch = a.convert.scratch.empty() || begins ? run.folder : a.convert.scratch;
  run.sync = !a.no_sync;
  run.observer = observe(progress);
  rgs::AtomicFile::Options output = a.convert.output;
  output.sync = run.sync;
  return rgs::run_parts(parts, run, describe, a.files.empty() ? "" : a.output(), output);
}

// ---- many scenes

tl::expected<rgs::ConvertSummary, rgs::BatchFailure> convert_one(const Arguments& all, const rgs::BatchScene& scene,
                                                                 const rgs::BatchShare& share) {
  Arguments arguments = all;
  arguments.files = {scene.input, scene.output_path};
  arguments.threads = static_cast<int>(share.threads);
  arguments.convert.encode.archive.threads = share.threads;
  arguments.convert.output.overwrite = share.overwrite;
  if (arguments.convert.scratch.empty()) arguments.convert.scratch = fs::path(scene.output_path).parent_path().string();
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, share.threads);
  std::deque<Input> inputs;
  std::deque<rgs::MappedFile> beside;
  const auto opened = open_inputs(arguments, inputs, beside);
  tool::Progress progress(tool::Progress::Mode::quiet);
  auto summary =
      opened ? convert_open(arguments, inputs, observe(progress)) : Outcome<rgs::ConvertSummary>(failed("", {}));
  if (summary) return std::move(*summary);
  const Failure& failure = opened ? summary.error() : opened.error();
  return tl::unexpected(rgs::BatchFailure{failure.file, failure.error});
}

// Reads a whole scene, with all its levels.
rgs::Status check_whole(const std::string& path, const rgs::DecodeLimits& limits) {
  Input input;
  if (rgs::Status s = input.open(path); !s) return s;
  if (rgs::has_levels(input.bytes())) {
    const auto paged = rgs::PagedFile::open(input.bytes(), limits);
    if (!paged) return tl::unexpected(paged.error());
    if (rgs::Status s = rgs::validate(*paged); !s) return s;
  }
  rgs::ReadOptions options;
  options.limits = limits;
  return input.read(options).map([](const rgs::SplatFile&) {});
}

// The inputs of many scenes and their output folder, or the exit code of a reported error.
tl::expected<rgs::BatchPlan, int> plan(const Arguments& a) {
  const auto usage = [](const std::string& message) { return tl::unexpected(tool::report_usage(message)); };
  if (a.merge) return usage("--merge takes files; each scene of a folder has its own output");
  if (a.audit) return usage("--audit takes one scene; run rgs-audit on the two folders afterwards");
  if (a.list.empty() && a.to == SplatFormat::unknown)
    return usage(a.files.front() + " is a folder; pass --to rgs, ply, spz, ... to convert all scenes in it");
  if (a.list.empty() && a.files.size() < 2)
    return usage(a.files.front() + " is a folder; name the output folder after it");
  if (a.files.size() > 2) return usage("give many scenes as one folder, or by --list");
  std::error_code ignored;
  if (a.files.size() == 2 && !fs::is_directory(a.files.front(), ignored))
    return usage("--list takes the output folder, optionally preceded by the input folder; " + a.files.front() +
                 " is not a folder");
  if (a.files.back() == "-" || a.files.front() == "-") return usage("many scenes need folders, not -");
  auto planned = rgs::plan_batch(a.list, a.files.size() == 2 ? a.files.front() : "", a.output(), a.to);
  if (planned) return std::move(*planned);
  if (!planned.error().usage.empty()) return usage(planned.error().usage);
  return tl::unexpected(tool::report(planned.error().file, planned.error().error));
}

// "2/8": the second of eight.
std::optional<std::pair<unsigned, unsigned>> parse_shard(const std::string& text) {
  unsigned shard = 0, n = 0;
  const char *first = text.data(), *last = first + text.size();
  const auto a = std::from_chars(first, last, shard);
  if (a.ec != std::errc() || a.ptr == last || *a.ptr != '/') return std::nullopt;
  const auto b = std::from_chars(a.ptr + 1, last, n);
  constexpr unsigned kMost = 100'000;
  if (b.ec != std::errc() || b.ptr != last || shard < 1 || shard > n || n > kMost) return std::nullopt;
  return std::pair(shard, n);
}

int convert_many(Arguments& arguments) {
  rgs::BatchOptions options;
  if (!arguments.shard.empty()) {
    const auto shard = parse_shard(arguments.shard);
    if (!shard) return tool::report_usage("--shard takes I/N, such as 2/8, not '" + arguments.shard + "'");
    std::tie(options.shard, options.n_shards) = *shard;
  }
  auto planned = plan(arguments);
  if (!planned) return planned.error();
  {
    Arguments one = arguments;  // for checks of one input and one output
    one.files = {"input", "output"};
    if (const auto message = check_arguments(one)) return tool::report_usage(*message);
    arguments.convert.levels = one.convert.levels;
    arguments.filter = one.filter;
  }
  settle_options(arguments);
  for (const rgs::BatchScene& scene : planned->scenes) {
    const SplatFormat to = arguments.to != SplatFormat::unknown ? arguments.to : rgs::format_of_name(scene.output_path);
    if (const auto message = check_format(arguments, to))
      return tool::report_usage(arguments.to != SplatFormat::unknown ? *message : scene.output + ": " + *message);
  }
  // Checks all shards' scenes, so that all machines agree.
  if (const std::string clash = rgs::outputs_that_clash(*planned, arguments.output()); !clash.empty())
    return tool::report_usage(clash);
  std::vector<std::string> outputs{arguments.report};
  tool::InputFiles inputs;
  inputs.add_cameras(arguments.cameras);
  inputs.add(arguments.list);
  for (const rgs::BatchScene& scene : planned->scenes) {
    inputs.add_scene(scene.input);
    outputs.push_back(scene.output_path);
  }
  for (std::string& state : rgs::state_files(arguments.output(), options)) outputs.push_back(std::move(state));
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  if (const auto read = read_cameras(arguments); !read) return report_failure(read.error());
  if (planned->scenes.empty())
    return tool::report_usage(arguments.list.empty() ? "no scene in " + arguments.files.front()
                                                     : "no scene is named in " + arguments.list);
  options.jobs = arguments.jobs;
  options.threads = n_threads(arguments);
  const std::uint64_t memory = arguments.convert.memory_bytes / options.jobs;
  if (memory < rgs::lod::kLeastMemory && arguments.memory_given)
    return tool::report_usage("--memory is divided among --jobs; each needs at least 128MiB");
  arguments.convert.memory_bytes = std::max(memory, rgs::lod::kLeastMemory);
  options.out = arguments.output();
  options.report = arguments.report == "-" ? "" : arguments.report;
  if (const int code = rgs::make_folder(options.out); code != tool::kSuccess) return code;  // the report may lie there
  if (!options.report.empty()) {
    if (const rgs::Status s = rgs::check_report(options.report, arguments.convert.output.overwrite); !s)
      return tool::report(options.report, s.error());
  }
  options.tool = "rgs-convert " RGS_VERSION;
  if (arguments.overwrite_damaged)
    options.check_output = [&arguments](const std::string& path) { return check_whole(path, arguments.limits); };
  options.keep_going = !arguments.stop;
  options.sync = !arguments.no_sync;
  options.overwrite = arguments.convert.output.overwrite;
  options.quiet = arguments.quiet;
  options.json = arguments.json;
  options.n_others = planned->n_others;
  if (!arguments.quiet) {
    for (const std::string& link : planned->refused)
      tool::print_error("rgs-convert: " + tool::printable(link) + ": a link to a folder that contains it, ignored\n");
  }
  const auto hash = rgs::options_hash(arguments.given, arguments.cameras);
  if (!hash) return tool::report(arguments.cameras, hash.error());
  options.options_hash = *hash;
  return rgs::run_batch(rgs::scenes_of_shard(std::move(planned->scenes), options.shard, options.n_shards), options,
                        [&arguments](const rgs::BatchScene& scene, const rgs::BatchShare& share) {
                          return convert_one(arguments, scene, share);
                        });
}

void choose_profile(const std::string& name, Arguments& a) {
  rgs::EncodeOptions& e = a.convert.encode;
  e.profile = name == "direct" ? rgs::Profile::direct : name == "packed" ? rgs::Profile::packed : rgs::Profile::archive;
  a.archive = name == "archive:small" ? rgs::archive_small() : rgs::archive_high();
}

// The user's steps override a preset's, once all options are read.
void add_archive_options(CLI::App& app, Arguments& a) {
  auto& c = a.archive_changes;
  app.add_option("--archive-mean-cells", c.mean_cells,
                 "archive: 2^N cells from the middle to a side of the scene's robust box, 4 to 20 [15; small 13]");
  app.add_option("--archive-sh-step", c.sh_step, "archive: step of SH above degree 0 [0.11; small 0.24]");
  app.add_option("--archive-dc-step", c.dc_step, "archive: step of SH degree 0 [0.14; small 0.3]");
  app.add_option("--archive-rotation-step", c.rotation_step,
                 "archive: step of quaternion components [0.0156; small 0.0357]");
  app.add_option("--archive-scale-step", c.scale_step, "archive: step of ln(scale) [0.15; small 0.35]");
  app.add_option("--archive-opacity-levels", c.opacity_levels, "archive: steps of opacity from 0 to 1 [96; small 32]");
  app.add_option("--archive-slope", c.slope,
                 "archive: steps fall with importance to the power of half of this, 0 to 1 [0.6]");
}

void add_batch_options(CLI::App& app, Arguments& a) {
  const std::string group = "Many scenes (docs/user/BATCH.md)";
  app.add_option("--list", a.list,
                 "Convert the inputs in this file, one a line, optionally followed by a tab and its output; - for "
                 "standard input. With --lod-partition: more inputs")
      ->option_text("FILE")
      ->group(group);
  app.add_option("--jobs,-j", a.jobs, "Scenes converted in parallel [1]; threads and --memory are divided among them")
      ->check(CLI::Range(1, 1024))
      ->group(group);
  app.add_option("--shard", a.shard, "Convert part I of N, for N machines that share a folder")
      ->option_text("I/N")
      ->group(group);
  app.add_flag("--keep-going", a.keep_going, "Go on after a scene that fails (default)")->group(group);
  app.add_flag("--no-keep-going", a.stop, "Start no further scene after one fails")
      ->excludes("--keep-going")
      ->group(group);
  app.add_flag("--overwrite-damaged", a.overwrite_damaged,
               "Read every existing output, and replace those that are damaged or cut off")
      ->group(group);
  app.add_option("--report", a.report, "Write each scene's line of JSON to this file instead of standard output")
      ->option_text("FILE")
      ->group(group);
}

void add_parts_options(CLI::App& app, Arguments& a) {
  const std::string group = "One scene in many processes (docs/user/CLUSTER.md)";
  auto* partition =
      app.add_option("--lod-partition", a.parts.partition,
                     "Begin or continue in this folder to convert the inputs as --lod does: scan them, plan, "
                     "place their Gaussians by range")
          ->option_text("FOLDER")
          ->group(group);
  auto* build = app.add_option("--lod-build", a.parts.build, "Then build the levels of ranges")
                    ->option_text("FOLDER")
                    ->group(group)
                    ->excludes(partition);
  auto* assemble = app.add_option("--lod-assemble", a.parts.assemble, "Then assemble them into one .rgs, the output")
                       ->option_text("FOLDER")
                       ->group(group)
                       ->excludes(partition)
                       ->excludes(build);
  app.add_option("--lod-list", a.parts.list, "Print as JSON the inputs and ranges, and what is done")
      ->option_text("FOLDER")
      ->group(group)
      ->excludes(partition)
      ->excludes(build)
      ->excludes(assemble);
  app.add_option("--ranges", a.parts.n_ranges, "Number of ranges; the output does not depend on it")
      ->check(CLI::Range(1, 65536))
      ->group(group);
  app.add_option("--lod-input", a.parts.selected,
                 "Inputs or ranges of this process, from 0: K, K-M, all, none [all]; all and none also plan")
      ->option_text("K|K-M|all|none")
      ->group(group);
}

void add_options(CLI::App& app, Arguments& a) {
  rgs::EncodeOptions& e = a.convert.encode;
  std::map<std::string, SplatFormat> readable, writable;
  for (const SplatFormat format : {SplatFormat::rgs, SplatFormat::ply, SplatFormat::compressed_ply, SplatFormat::spz,
                                   SplatFormat::splat, SplatFormat::ksplat, SplatFormat::sog, SplatFormat::glb}) {
    readable.emplace(rgs::format_name(format), format);
    if (format == SplatFormat::rgs || rgs::is_writable(format)) writable.emplace(rgs::format_name(format), format);
  }
  const std::map<std::string, rgs::BadPolicy> policies{
      {"refuse", rgs::BadPolicy::refuse}, {"drop", rgs::BadPolicy::drop}, {"repair", rgs::BadPolicy::repair}};
  const std::map<std::string, rgs::DepthMapping> mappings{{"linear", rgs::DepthMapping::linear},
                                                          {"log", rgs::DepthMapping::logarithmic}};
  const std::map<std::string, rgs::AaMode> aa_modes{{"undeclared", rgs::AaMode::undeclared},
                                                    {"classic", rgs::AaMode::classic},
                                                    {"mip", rgs::AaMode::mip_splatting},
                                                    {"mip-splatting", rgs::AaMode::mip_splatting}};
  const std::map<std::string, rgs::ColourSpace> colour_spaces{{"undeclared", rgs::ColourSpace::undeclared},
                                                              {"srgb", rgs::ColourSpace::srgb_display},
                                                              {"linear", rgs::ColourSpace::linear_display}};
  app.add_option("files", a.files,
                 "Inputs, " RGS_SCENE_FORMATS
                 " (several with --merge), then the output; - for a standard stream. Or a folder of scenes, then the "
                 "output folder")
      ->expected(0, -1)
      ->option_text("input... output");
  app.add_option("--from", a.from, "Format of the inputs; default: detected from their content")
      ->transform(tool::one_of(readable))
      ->option_text("rgs|ply|compressed.ply|spz|splat|ksplat|sog|glb");
  app.add_option("--to", a.to, "Format of the output; default: from its name")
      ->transform(tool::one_of(writable))
      ->option_text("rgs|ply|compressed.ply|spz|splat|glb");
  app.add_option("--spz-version", a.convert.spz_version,
                 "Version of an SPZ [3]: Spark reads 2 and 3, GaussianSplats3D 2, PlayCanvas's engine 4 "
                 "(docs/user/INTERCHANGE.md)")
      ->check(CLI::IsMember({2, 3, 4}))
      ->option_text("2|3|4")
      ->each([&a](const std::string&) { a.spz_version_given = true; });
  app.add_flag("--skip-unknown-extensions", a.skip_unknown_extensions,
               "Skip an SPZ's extensions of unknown type, though they may change what its Gaussians mean");
  tool::add_spz_axes(app, a.spz_axes);
  app.add_flag("--merge", a.merge, "Merge several inputs into one output");
  e.profile = rgs::Profile::packed;
  app.add_option_function<std::string>(
         "--profile", [&a](const std::string& name) { choose_profile(name, a); },
         "packed (the default), or direct: as the GPU reads it; same Gaussians. archive:high or archive:small: lossy "
         "within stated bounds, a fifth of packed's size or less (docs/user/PROFILES.md)")
      ->check(CLI::IsMember({"packed", "direct", "archive", "archive:high", "archive:small"}))
      ->option_text("packed|direct|archive:high|archive:small")
      ->trigger_on_parse();
  add_archive_options(app, a);
  app.add_option("--level", e.level, "Effort of packed, 1 to 19 [1]: higher is slower to write and a little smaller")
      ->check(CLI::Range(1, rgs::kMaxLevel));
  app.add_flag("--keep-order", a.keep_order, "Keep the order of the input instead of a Morton curve");
  app.add_flag("--keep-permutation", e.keep_permutation, "Store each Gaussian's position in the input (4 bytes)");
  app.add_option("--chunk-size", e.chunk_size, "Gaussians per chunk, a multiple of 32 from 32 to 65536 [256]");
  app.add_flag("--file-scales", a.file_scales, "One set of SH scales for the file instead of one per chunk");
  app.add_flag("--lod", a.lod, "Add levels of detail (docs/develop/LEVELS.md)");
  app.add_option("--lod-quality", a.lod_quality, "Effort of fitting levels [fast]")
      ->transform(tool::one_of(std::map<std::string, rgs::lod::Quality>{{"fast", rgs::lod::Quality::fast},
                                                                        {"best", rgs::lod::Quality::best}}));
  app.add_option("--memory", a.convert.memory_bytes,
                 "Memory that --lod may take for inputs in PLY, at least 128MiB [2GiB]")
      ->transform(CLI::AsSizeValue(false))
      ->option_text("BYTES");
  app.add_option("--scratch", a.convert.scratch,
                 "Folder for temporary files of --lod, about 1.2 times the size of a PLY [the output's]");
  app.add_option("--sh-degree", e.sh_degree, "Strip SH above this degree")->check(CLI::Range(0, 3));
  app.add_option("--on-bad", e.on_bad, "Damaged Gaussians; by default they are dropped if at most 1 % are damaged")
      ->transform(tool::one_of(policies))
      ->option_text("refuse|drop|repair")
      ->each([&a](const std::string&) { a.explicit_policy = true; });
  app.add_flag("--strict", a.convert.strict,
               "Write nothing (exit code 4) if Gaussians are damaged or beyond the range of the output's format")
      ->excludes("--on-bad");
  app.add_flag("--allow-rounding", a.convert.allow_rounding,
               "Write positions that FP32 relative to the scene's one origin rounds by more than a millimetre");
  app.add_option("--cameras", a.cameras, "Set the sort key's depth range for these cameras (docs/user/CAMERAS.md)");
  app.add_option("--near", a.convert.z_near, "Near end of the depth range, world units")->check(CLI::PositiveNumber);
  app.add_option("--far", a.convert.z_far, "Far end of the depth range, world units")->check(CLI::PositiveNumber);
  app.add_option("--depth-map", a.asked.depth_mapping, "Mapping of depth to the sort key [an .rgs's, else log]")
      ->transform(tool::one_of(mappings))
      ->option_text("linear|log");
  app.add_option("--axes", a.axes,
                 "Directions of the input's +x,+y,+z, if not its format's: 3dgs (right,down,forward), opengl "
                 "(right,up,backward), gltf (left,up,forward), undeclared, or three directions")
      ->each([&a](const std::string&) { a.axes_given = true; });
  app.add_option("--to-axes", a.to_axes, "Turn the scene to these axes; default: docs/user/INTERCHANGE.md")
      ->each([&a](const std::string&) { a.to_axes_given = true; });
  app.add_option("--translate", a.translate,
                 "Move each input, or the first, the second, ...: x,y,z in the output's axes")
      ->allow_extra_args(false);
  app.add_option("--rotate", a.rotate, "Turn it first: degrees about x, y, z in turn, or a quaternion w,x,y,z")
      ->allow_extra_args(false);
  app.add_option("--scale", a.scale, "Scale it first: one factor")->allow_extra_args(false);
  app.add_option("--crop", a.crop, "Keep Gaussians with means between two corners x,y,z,X,Y,Z of the placed scene");
  app.add_option("--min-opacity", a.filter.min_opacity, "Keep Gaussians of at least this opacity")
      ->check(CLI::Range(0.0, 1.0));
  app.add_option("--max-count", a.max_count,
                 "Keep at most this many (200k, 1.5M) after --crop and --min-opacity: of a file with levels of "
                 "detail the finest cut with no more, of others those with the largest opacity times "
                 "area");
  app.add_option("--level-of-detail", a.level_of_detail,
                 "Level to read of .rgs files with levels of detail; 0, the default: the scene's own Gaussians");
  app.add_option("--aa,--aa-mode", a.asked.aa_mode,
                 "Anti-aliasing that the scene was trained with [the input's, else classic]")
      ->transform(tool::one_of(aa_modes))
      ->option_text("classic|mip|mip-splatting|undeclared");
  app.add_option("--low-pass", a.asked.low_pass_px2,
                 "px^2 added to projected covariances in training [the input's, else 0.3, mip 0.1]")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--colour-space", a.asked.colour_space, "Colours that SH evaluates to")
      ->transform(tool::one_of(colour_spaces))
      ->option_text("srgb|linear|undeclared");
  app.add_option("--metres-per-unit", a.asked.metres_per_unit, "Size of a unit of the output, if known")
      ->check(CLI::NonNegativeNumber);
  tool::add_max_expansion(app, a.limits);
  app.add_flag("--audit", a.audit, "Then run rgs-audit, write OUTPUT.audit.html and return its exit code");
  app.add_flag("--overwrite", a.convert.output.overwrite,
               "Replace an existing output; with many scenes, convert all again");
  app.add_flag("--no-sync", a.no_sync, "Do not wait until the output is on disk");
  app.add_option("--threads", a.threads, "Threads; default: all")->check(CLI::Range(1, 1024));
  app.add_flag("--json", a.json, "Summary as JSON on standard output (docs/user/CONVERT_JSON.md)");
  app.add_flag("--quiet,-q", a.quiet, "No progress, no summary");
  add_batch_options(app, a);
  add_parts_options(app, a);
  app.footer(
      "Writes .rgs, .ply, .compressed.ply, .spz, .splat and .glb.\n"
      "Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input, 6 a file with levels of detail "
      "is cut off and lacks what was asked for; with --audit also those of rgs-audit. Many scenes return the worst, in "
      "this order: 1, 3, 2, 4, 6.");
  for (const char* name : kRgsOptions) app.get_option(name)->group("Options for .rgs output");
}

// The options that affect an output, sorted so that their order does not matter.
std::string given_options(const CLI::App& app) {
  constexpr std::string_view kUnseen[] = {"files",           "--threads",       "--memory",
                                          "--scratch",       "--overwrite",     "--json",
                                          "--no-sync",       "--quiet",         "--overwrite-damaged",
                                          "--cameras",       "--list",          "--jobs",
                                          "--shard",         "--report",        "--keep-going",
                                          "--no-keep-going", "--lod-partition", "--lod-build",
                                          "--lod-assemble",  "--lod-list",      "--lod-input",
                                          "--ranges"};
  std::map<std::string, std::string> given;
  for (const CLI::Option* option : app.get_options()) {
    if (option->count() == 0 || std::ranges::find(kUnseen, option->get_name()) != std::end(kUnseen)) continue;
    std::string& values = given[option->get_name()];
    for (const std::string& value : option->results()) values += " '" + value + "'";
  }
  std::string text;
  for (const auto& [name, values] : given) text += name + values + "\n";
  return text;
}

int parse_and_convert(int argc, char** argv) {
  CLI::App app("Converts trained 3D Gaussian splat scenes between .rgs and other formats.", "rgs-convert");
  app.set_version_flag("--version", "rgs-convert " RGS_VERSION);
  Arguments arguments;
  add_options(app, arguments);
  if (const auto code = tool::parse(app, argc, argv)) return *code;
  for (const char* name : kRgsOptions) {
    if (app.get_option(name)->count() != 0) arguments.rgs_option = name;
  }
  arguments.given = given_options(app);
  arguments.memory_given = app.get_option("--memory")->count() != 0;
  if (!arguments.parts.folder().empty()) {
    if (const auto message = check_parts_options(app, arguments.parts)) return tool::report_usage(*message);
    return convert_parts(arguments);
  }
  for (const char* name : {"--lod-input", "--ranges"}) {
    if (app.get_option(name)->count() != 0)
      return tool::report_usage(std::string(name) + " requires --lod-partition or --lod-build");
  }
  if (arguments.files.empty()) return tool::report_usage("files are required: rgs-convert INPUT OUTPUT");
  std::error_code ignored;
  if (!arguments.list.empty() || fs::is_directory(arguments.files.front(), ignored)) return convert_many(arguments);
  if (arguments.files.size() < 2) return tool::report_usage("an input needs an output: rgs-convert INPUT OUTPUT");
  for (const std::string_view name : kBatchOptions)
    if (app.get_option(std::string(name))->count() != 0)
      return tool::report_usage(std::string(name) + " requires a folder of scenes or --list");
  return convert_main(arguments);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&] { return parse_and_convert(argc, argv); });
}
