// one_scene.cpp - the options of what is written, and how one scene is converted: row by row, tile by tile or in memory.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/global_control.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <set>
#include <thread>
#include <utility>

#include "convert_summary.hpp"
#include "fit_device.hpp"
#include "input_files.hpp"
#include "keep_levels.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "rgs_convert.hpp"
#include "stage_clock.hpp"
#include "system.hpp"

namespace rgs {
namespace {

bool concerns_output(Errc code) {
  return code == Errc::write_failed || code == Errc::output_exists || code == Errc::output_unusable;
}

// Truncated parts of a mapped input read as zeros, so a change of the file explains any other error.
Failure explained(Failure failure, const std::deque<SceneInput>& inputs) {
  if (concerns_output(failure.error.code)) return failure;
  for (const SceneInput& input : inputs) {
    if (const Status s = input.file().check_unchanged(); !s) return {input.path(), s.error()};
  }
  return failure;
}

// Whether levels are built from tiles, so that inputs are not in memory together: several, or one that is read in parts.
// Filters need all Gaussians in memory, and so does a single .rgs, which may name a source of its own.
bool streams_tiles(const ConvertArguments& arguments, const std::deque<SceneInput>& inputs, SplatFormat to) {
  const SplatFormat from = arguments.scene.format_of(inputs.front());
  return to == SplatFormat::rgs && arguments.output.levels && arguments.scene.filter.keeps_all() &&
         !arguments.scene.level_of_detail &&
         (inputs.size() > 1 || (format_info(from).in_parts && from != SplatFormat::rgs));
}

// The file, or the folder of scratch files, that an error is about.
std::string concerned(const ConvertArguments& arguments, const SceneInput& input, const Error& error) {
  if (!lod::concerns_scratch(error)) return concerns_output(error.code) ? arguments.scene.output() : input.path();
  return arguments.output.convert.scratch.empty() ? "." : arguments.output.convert.scratch;
}

// Equals load_scene() and convert_scene(), tile by tile.
Outcome<ConvertSummary> convert_tiles(ConvertArguments& arguments, const std::deque<SceneInput>& inputs,
                                      DeclaredLoss& loss, const StageObserver& observer) {
  const SceneOptions& options = arguments.scene;
  ConvertOptions& convert = arguments.output.convert;
  EncodeOptions& encode = convert.encode;
  std::vector<Tile> tiles(inputs.size());
  std::vector<InputDeclarations> declared;
  std::vector<std::string> unused;
  std::uint64_t bytes = 0;
  SplatFormat first_format = SplatFormat::unknown;
  for (std::size_t i = 0; i < inputs.size(); ++i) {
    auto opened = open_tile(options, inputs[i], i, loss.notes);
    if (!opened) return tl::unexpected(opened.error());
    if (i == 0) first_format = opened->format;
    if (i == 0) encode.axes = options.target_axes(opened->tile.axes, opened->format, SplatFormat::rgs);
    bytes += opened->bytes;
    unused.insert(unused.end(), opened->unused.begin(), opened->unused.end());
    declared.push_back(std::move(opened->declared));
    tiles[i] = std::move(opened->tile);
  }
  std::size_t tile = 0;
  const auto scene = TileStream::open(std::move(tiles), encode.axes, tile);
  if (!scene) return failed(inputs[tile].path(), scene.error());
  if (auto s = declare_scene(encode, declared, options.asked, loss.notes); !s)
    return failed(inputs.front().path(), s.error());
  encode.n_source = scene->size();
  encode.n_repaired = 0;
  StreamFacts facts;
  facts.bytes = bytes;
  facts.origin = scene->origin();
  facts.hash = [&inputs] {
    std::vector<std::uint64_t> hashes(inputs.size());
    std::ranges::transform(inputs, hashes.begin(), &SceneInput::hash);
    return hash_of_sources(hashes);
  };
  facts.rounding = [&scene] { return scene->rounding(); };
  auto summary = convert_to_levels(scene->stream(), facts, options.output(), convert, observer);
  if (!summary) return failed(concerned(arguments, inputs[scene->reading()], summary.error()), summary.error());
  summary->source_format = inputs.size() == 1 ? format_name(first_format) : "merged";
  summary->unused = std::move(unused);
  summary->notes = std::move(loss.notes);
  return std::move(*summary);
}

// Whether levels that the file may have of its own become levels of the .rgs: without --lod, which builds new ones, and
// without what changes or reorders Gaussians.
bool may_keep_levels(const ConvertArguments& arguments, SplatFormat from, SplatFormat to) {
  return to == SplatFormat::rgs && from != SplatFormat::rgs && format_info(from).keeps.levels &&
         !arguments.output.levels && !arguments.scene.edits() && arguments.output.convert.encode.order == Order::morton;
}

// As convert_tiles(); `tree` has levels.
Outcome<ConvertSummary> convert_kept(ConvertArguments& arguments, const SceneInput& input, LevelTree tree,
                                     DeclaredLoss& loss, const StageObserver& observer) {
  const SceneOptions& options = arguments.scene;
  ConvertOptions& convert = arguments.output.convert;
  EncodeOptions& encode = convert.encode;
  const Axes axes = options.axes.value_or(tree.file.axes);
  const SplatFormat from = tree.file.format;
  encode.axes = options.target_axes(axes, from, SplatFormat::rgs);
  observer.begin("read", 0, "");
  const auto kept = KeptLevels::open(std::move(tree), axes, encode);
  observer.finish();
  if (!kept) return failed(input.path(), kept.error());
  SplatFile declared = kept->file();
  declared.axes = axes;
  const InputDeclarations by_input = declared_by(declared, input.name(), {});
  if (auto s = declare_scene(encode, {&by_input, 1}, options.asked, loss.notes); !s)
    return failed(input.path(), s.error());
  const SceneScan& coarser = kept->coarser();
  if (const std::uint64_t n = coarser.n_source() - coarser.n_kept(); n != 0)
    loss.notes.push_back(tool::format_count(n) + " damaged Gaussians of coarser levels dropped");
  if (const std::uint64_t n = coarser.n_repaired(); n != 0)
    loss.notes.push_back(tool::format_count(n) + " damaged Gaussians of coarser levels repaired");
  const lod::SplatStream leaves = kept->leaves();
  encode.n_source = leaves.n;
  encode.n_repaired = 0;
  StreamFacts facts;
  facts.bytes = declared.bytes;
  facts.origin = declared.origin;
  convert_axes(facts.origin, axes, encode.axes);
  facts.hash = [&input] { return input.hash(); };
  facts.rounding = [&kept] { return kept->rounding(); };
  facts.arrange = [&kept](auto&... of) { return kept->arrange(of...); };
  auto summary = convert_to_levels(leaves, facts, options.output(), convert, observer);
  if (!summary) return failed(concerned(arguments, input, summary.error()), summary.error());
  summary->source_format = format_name(from);
  summary->unused = declared.unused;
  summary->notes = std::move(loss.notes);
  return std::move(*summary);
}

Outcome<ConvertSummary> convert_inputs(ConvertArguments& arguments, const std::deque<SceneInput>& inputs,
                                       SplatFormat to, const StageObserver& observer) {
  const SceneOptions& options = arguments.scene;
  ConvertOptions& convert = arguments.output.convert;
  const SceneInput& first = inputs.front();
  const SplatFormat from = options.format_of(first);
  const bool may_keep = may_keep_levels(arguments, from, to);
  if (arguments.output.limits_memory && !arguments.output.levels && !may_keep)
    return failed(first.path(), {Errc::bad_argument, Error::kNone,
                                 "--memory and --scratch require --lod, or a file whose own levels are kept"});
  DeclaredLoss loss;
  const auto outcome = [&](Result<ConvertSummary> summary) -> Outcome<ConvertSummary> {
    if (!summary) return failed(concerned(arguments, first, summary.error()), summary.error());
    summary->notes.insert(summary->notes.begin(), loss.notes.begin(), loss.notes.end());
    return std::move(*summary);
  };
  const auto declare = [&](const InputDeclarations& by_input) {
    return declare_scene(convert.encode, {&by_input, 1}, options.asked, loss.notes);
  };
  if (from == SplatFormat::ply && to == SplatFormat::rgs && !options.edits()) {
    const auto ply = PlyFile::open(first.bytes());
    if (!ply) return failed(first.path(), ply.error());
    if (!options.axes) convert.encode.axes = ply->declarations().axes;
    InputDeclarations declared = declared_by(*ply, first.name());
    declared.stated.axes = convert.encode.axes;
    declare_prj(declared, first.prj(), options.asked, loss.notes);
    if (auto s = declare(declared); !s) return failed(first.path(), s.error());
    return outcome(convert_to_rgs(*ply, options.output(), convert, observer));
  }
  const bool with_levels = inputs.size() == 1 && has_levels(first.bytes()) && !options.edits();
  if (to == SplatFormat::ssog || (with_levels && (to == SplatFormat::rad || to == SplatFormat::tileset))) {
    if (!with_levels)
      return failed(first.path(),
                    {Errc::unsupported_feature, 0,
                     "a streamed SOG is written from one .rgs with levels of detail, as it is: write that "
                     "first (rgs-convert --lod), with all that changes or filters Gaussians"});
    const auto paged = PagedFile::open(first.bytes(), options.limits);
    if (!paged) return failed(first.path(), paged.error());
    convert.encode.axes = options.axes.value_or(paged->head().declarations().axes);
    if (auto s = declare(declared_by(paged->head(), first.name())); !s) return failed(first.path(), s.error());
    return outcome(convert_levels(*paged, to, options.output(), convert, observer));
  }
  if (from == SplatFormat::rgs && to == SplatFormat::ply && !options.edits() && !has_levels(first.bytes())) {
    const auto view = FileView::open(first.bytes(), options.limits);
    if (!view) return failed(first.path(), view.error());
    const Axes& axes = view->declarations().axes;
    const bool as_is = axes == kAxes3dgs || axes[0] == Axis::undeclared;
    if (as_is && !options.axes && view->header().sh_degree <= convert.encode.sh_degree) {
      if (auto s = declare(declared_by(*view, first.name())); !s) return failed(first.path(), s.error());
      EncodeOptions encode = convert.encode;
      encode.axes = axes;
      return outcome(convert_rgs_to_ply(*view, options.output(), convert.output, observer,
                                        stated_by(encode, view->declarations())));
    }
  }
  if (may_keep) {
    const EncodeOptions encode = convert.encode;
    const DeclaredLoss before = loss;
    // Where levels cannot be kept the finest can often be read, if memory is not limited.
    const auto is_without = [&](const Error& error) {
      if (error.code != Errc::limit_exceeded && error.code != Errc::unsupported_feature) return false;
      if (arguments.output.limits_memory) return false;
      observer.finish();
      convert.encode = encode;
      loss = before;
      loss.notes.push_back(std::string("levels of detail are not kept: ") + error.what);
      return true;
    };
    auto tree = first.levels(options.read_options());
    if (!tree && !is_without(tree.error())) return failed(first.path(), tree.error());
    const auto above = [](const LevelTree::Node& node) { return node.level > 0; };
    if (tree && std::ranges::any_of(tree->nodes, above)) {
      auto kept = convert_kept(arguments, first, std::move(*tree), loss, observer);
      if (kept || !is_without(kept.error().error)) return kept;
    }
  }
  if (streams_tiles(arguments, inputs, to)) return convert_tiles(arguments, inputs, loss, observer);
  std::vector<std::pair<const char*, double>> seconds;
  StageClock clock(observer, seconds);
  clock.begin("read", 0, "");
  auto scene = load_scene(options, convert, inputs, to, loss);
  if (!scene) return tl::unexpected(scene.error());
  clock.end();
  auto summary = convert_scene(std::move(*scene), to, options.output(), convert, observer);
  if (summary) {
    summary->seconds.insert(summary->seconds.begin(), seconds.begin(), seconds.end());
    summary->lost.insert(summary->lost.end(), loss.lost.begin(), loss.lost.end());
  }
  return outcome(std::move(summary));
}

}  // namespace

void OutputOptions::add_to(CLI::App& app) {
  EncodeOptions& e = convert.encode;
  e.profile = Profile::packed;
  const auto writable = formats_by_name(true);
  app.option_defaults()->group(kSceneGroup);
  app.add_option("--to", to, "Format of the output; default: from its name")
      ->transform(tool::one_of(writable))
      ->option_text(tool::names_of(writable, "|"));
  app.add_option("--spz-version", spz_version,
                 "Version of an SPZ [3]: Spark reads 2 and 3, GaussianSplats3D 2, PlayCanvas's engine 4 "
                 "(docs/user/INTERCHANGE.md)")
      ->check(CLI::IsMember({2, 3, 4}))
      ->option_text("2|3|4");
  app.add_flag_callback(
      "--keep-order", [&e] { e.order = Order::input; }, "Keep the order of the input instead of a Morton curve");
  app.add_option("--sh-degree", e.sh_degree, "Strip SH above this degree")->check(CLI::Range(0, 3));
  app.add_option("--on-bad", on_bad, "Damaged Gaussians; by default they are dropped if at most 1 % are damaged")
      ->transform(tool::one_of<BadPolicy>(
          {{"refuse", BadPolicy::refuse}, {"drop", BadPolicy::drop}, {"repair", BadPolicy::repair}}))
      ->option_text("refuse|drop|repair");
  app.add_flag("--strict", convert.strict,
               "Write nothing (exit code 4) if Gaussians are damaged or beyond the range of the output's format")
      ->excludes("--on-bad");
  app.add_flag("--allow-rounding", convert.allow_rounding,
               "Write positions that FP32 relative to the scene's one origin rounds by more than a millimetre");

  app.option_defaults()->group(kRgsGroup);
  app.add_option_function<std::string>(
         "--profile",
         [&e](const std::string& name) {
           e.profile = name == "direct" ? Profile::direct : name == "packed" ? Profile::packed : Profile::archive;
           e.archive = name == "archive:tiny"    ? archive_tiny()
                       : name == "archive:small" ? archive_small()
                                                 : archive_high();
         },
         "packed (the default), or direct: as the GPU reads it; same Gaussians. archive:high, archive:small or "
         "archive:tiny: lossy within stated bounds, a fifth of packed's size or less (docs/user/PROFILES.md)")
      ->check(CLI::IsMember({"packed", "direct", "archive", "archive:high", "archive:small", "archive:tiny"}))
      ->option_text("packed|direct|archive:high|archive:small|archive:tiny")
      ->trigger_on_parse();  // before the steps below, which override a preset's wherever they are given
  auto* step = app.add_option(
      "--archive-step", e.archive.step,
      "archive: size of all steps, 1/16 to 64: twice as large, errors are twice as large [1; small 2.2; tiny 5.25]");
  auto* psnr = app.add_option("--target-psnr", target.psnr,
                              "archive: find the step of the smallest file with this PSNR, dB, that rgs-audit measures "
                              "at --cameras or at its own views; three conversions at most")
                   ->check(CLI::Range(1.0, 150.0))
                   ->excludes(step)
                   ->option_text("DB");
  tool::add_bytes(app, "--target-size", target.bytes,
                  "archive: find the step of the best file of at most this size; three conversions at most")
      ->excludes(step)
      ->excludes(psnr);
  app.add_option("--level", e.level, "Effort of packed, 1 to 19 [1]: higher is slower to write and a little smaller")
      ->check(CLI::Range(1, kMaxLevel));
  app.add_flag("--keep-permutation", e.keep_permutation, "Store each Gaussian's position in the input (4 bytes)");
  app.add_option("--chunk-size", e.chunk_size, "Gaussians per chunk, a multiple of 32 from 32 to 65536 [256]");
  app.add_flag_callback(
      "--file-scales", [&e] { e.chunk_step_sets = false; },
      "One set of SH scales for the file instead of one per chunk");
  app.add_flag("--lod", levels, "Add levels of detail (docs/develop/LEVELS.md)");
  app.add_option("--lod-quality", lod_quality, "best: fit the colours of levels to pictures, slower [fast]")
      ->transform(tool::one_of<lod::Quality>({{"fast", lod::Quality::fast}, {"best", lod::Quality::best}}));
  app.add_option_function<std::string>(
         "--backend", [this](const std::string& name) { on_cuda = name == "cuda"; },
         "cuda: --lod-quality best fits on the GPU, whose roundings differ [cpu]")
      ->check(CLI::IsMember({"cpu", "cuda"}))
      ->option_text("cpu|cuda");
  app.add_option("--cameras", cameras,
                 "Set the sort key's depth range for these cameras, and the first view to the best of them "
                 "(docs/user/CAMERAS.md)");
  app.add_option("--near", convert.z_near, "Near end of the depth range, world units")->check(CLI::PositiveNumber);
  app.add_option("--far", convert.z_far, "Far end of the depth range, world units")->check(CLI::PositiveNumber);

  app.option_defaults()->group(kLevelsGroup);
  tool::add_bytes(app, "--memory", memory_bytes,
                  "Memory that --lod may take for inputs in PLY, and levels that are kept, at least 128MiB [2GiB]");
  app.add_option("--scratch", convert.scratch,
                 "Folder for temporary files of --lod, about 1.2 times the size of a PLY [the output's]");

  app.option_defaults()->group(kRunGroup);
  app.add_flag("--overwrite", convert.output.overwrite,
               "Replace an existing output; with many scenes, convert all again");
  app.add_flag_callback(
      "--no-sync", [this] { convert.output.sync = false; }, "Do not wait until the output is on disk");
}

std::optional<std::string> OutputOptions::check() const {
  const std::uint64_t memory = memory_bytes.value_or(lod::kDefaultMemory);
  if (target.option() != nullptr && convert.encode.profile != Profile::archive)
    return std::string(target.option()) + " requires --profile archive";
  if (target.bytes == 0) return "--target-size must be more than 0";
  if (lod_quality && !levels) return "--lod-quality requires --lod";
  if (on_cuda && lod_quality != lod::Quality::best) return "--backend cuda requires --lod-quality best";
  if (memory < lod::kLeastMemory) return "--memory must be at least 128MiB";
  return std::nullopt;
}

std::optional<std::string> OutputOptions::check_format(const SceneOptions& scene, SplatFormat format) const {
  if (format == SplatFormat::unknown)
    return "cannot tell the output's format from its name (" + format_list(true) + "); pass --to";
  if (!format_info(format).writable) return std::string("the format ") + format_name(format) + " is read only";
  if (format != SplatFormat::rgs && !rgs_option.empty()) return rgs_option + " is for .rgs outputs";
  if (format != SplatFormat::spz && spz_version) return "--spz-version is for .spz outputs";
  if (format_info(format).axes != kAxes3dgs && scene.to_axes)
    return std::string("the axes of ") + format_name(format) + " are prescribed by the format";
  if (format == SplatFormat::tileset && !scene.output().ends_with(".json"))
    return "a tileset is a folder: name its tileset.json";
  if (format == SplatFormat::spz && scene.to_axes) return "--spz-axes chooses the axes of .spz outputs";
  return std::nullopt;
}

void OutputOptions::settle(const SceneOptions& scene, int threads) {
  EncodeOptions& e = convert.encode;
  e.axes = scene.axes.value_or(kAxes3dgs);
  e.archive.threads = static_cast<unsigned>(threads);
  if (on_bad) {
    e.on_bad = *on_bad;
    e.max_bad_fraction = 1;
  }
  if (convert.strict) e.on_bad = BadPolicy::refuse;
  if (spz_version) convert.spz_version = *spz_version;
  if (memory_bytes) convert.memory_bytes = *memory_bytes;
  limits_memory = memory_bytes || !convert.scratch.empty();
  if (levels) convert.levels = lod_quality.value_or(lod::Quality::fast);
}

Outcome<void> OutputOptions::read_cameras() {
  if (cameras.empty()) return {};
  auto read = rgs::read_cameras(cameras);
  if (!read) return failed(cameras, read.error());
  convert.cameras = std::move(*read);
  return {};
}

void RunOptions::add_to(CLI::App& app) {
  app.option_defaults()->group(kRunGroup);
  app.add_option("--threads", threads, "Threads; default: all")->check(CLI::Range(1, 1024));
  app.add_flag("--json", json, "Summary as JSON on standard output (docs/user/CONVERT_JSON.md)");
  app.add_flag("--quiet,-q", quiet, "No progress, no summary");
}

unsigned RunOptions::n_threads() const {
  return threads > 0 ? static_cast<unsigned>(threads) : std::max(1u, std::thread::hardware_concurrency());
}

void RunOptions::print_summary(const ConvertSummary& summary, const std::string& output) const {
  if (json) {
    tool::print(summary_json(summary));
  } else if (!quiet) {
    (output == "-" ? tool::print_error : tool::print)(summary_text(summary));
  }
}

std::optional<std::string> ConvertArguments::settle() {
  if (auto message = scene.check()) return message;
  if (auto message = output.check()) return message;
  if (run.json && scene.output() == "-") return "--json and output - both need standard output";
  output.settle(scene, run.threads);
  return std::nullopt;
}

int ConvertArguments::check_outputs() const {
  tool::InputFiles inputs;
  for (const std::string& path : scene.inputs()) inputs.add_scene(path);
  inputs.add_cameras(output.cameras);
  const bool prints = scene.output() != "-" && (run.json || !run.quiet);
  const std::array<std::string, 3> outputs{scene.output(), audit ? audit_report(scene.output()) : "",
                                           prints ? "-" : ""};
  return inputs.check_outputs(outputs);
}

StageObserver observe(tool::Progress& progress) {
  StageObserver observer;
  observer.begin = [&progress](const char* stage, std::uint64_t total, const char* unit) {
    progress.begin(stage, total, unit);
  };
  observer.advance = [&progress](std::uint64_t units) { progress.advance(units); };
  observer.finish = [&progress] { progress.finish(); };
  return observer;
}

int report_failure(const Failure& failure) {
  return tool::report(failure.file, failure.error);
}

Outcome<OpenInputs> open_inputs(ConvertArguments& arguments) {
  OpenInputs inputs;
  std::vector<const MappedFile*>& unchanged = arguments.output.convert.output.inputs;
  tool::InputFiles scenes;
  const std::span<const std::string> paths = arguments.scene.inputs();
  for (const std::string& path : paths) scenes.add_scene(path);
  constexpr std::size_t kOthers = 64;                       // output, scratch files
  tool::allow_open_files(scenes.paths().size() + kOthers);  // inputs stay open until the output is renamed
  for (const std::string& path : paths) {
    if (const Status s = inputs.scenes.emplace_back().open(path); !s) return failed(path, s.error());
    unchanged.push_back(&inputs.scenes.back().file());
  }
  std::set<std::pair<std::uint64_t, std::uint64_t>> identities;
  for (const std::string& path : scenes.paths()) {
    if (path == "-") continue;
    if (const auto status = detail::status_of(path)) identities.emplace(status->device, status->inode);
  }
  arguments.output.convert.is_input = [read = std::move(identities)](const std::string& path) {
    const auto status = detail::status_of(path);
    return status && read.contains({status->device, status->inode});
  };
  // A tileset may have more files than may be open, often 1,024: later ones are not watched for changes.
  constexpr std::size_t kMostBeside = 900;
  const bool of_tileset = std::ranges::any_of(
      inputs.scenes, [](const SceneInput& input) { return detect_format(input.bytes()) == SplatFormat::tileset; });
  for (const std::string& path : scenes.paths()) {
    if (std::ranges::find(paths, path) != paths.end()) continue;
    if (of_tileset && inputs.beside.size() == kMostBeside) break;
    auto file = MappedFile::open(path);
    if (!file) return failed(path, file.error());
    unchanged.push_back(&inputs.beside.emplace_back(std::move(*file)));
  }
  return inputs;
}

Outcome<ConvertSummary> convert_open(ConvertArguments& arguments, const std::deque<SceneInput>& inputs,
                                     tool::Progress::Mode mode) {
  if (arguments.output.on_cuda && arguments.output.convert.build.device == nullptr) {
    auto opened = lod::FitDevice::create();  // not before: a device does not survive the fork of a batch
    if (!opened) return failed("--backend", opened.error());
    arguments.output.convert.build.device = std::move(*opened);
  }
  tool::Progress progress(mode);
  std::uint64_t source_bytes = 0;
  for (const SceneInput& input : inputs) source_bytes += input.bytes().size();
  const std::string name = inputs.size() == 1 ? inputs.front().name() : inputs.front().name() + " and more";
  arguments.output.convert.encode.provenance = Provenance{source_bytes, 0, name, "rgs-convert " RGS_VERSION};
  std::string& scratch = arguments.output.convert.scratch;
  const std::string& output = arguments.scene.output();
  if (scratch.empty() && output != "-") scratch = detail::path_of(output).parent_path().string();
  auto summary = convert_inputs(arguments, inputs, arguments.output.format_of(output), observe(progress));
  if (!summary) return tl::unexpected(explained(std::move(summary.error()), inputs));
  summary->source_name = name;
  note_rounding(*summary);
  return summary;
}

int convert_one_scene(ConvertArguments& arguments) {
  const SceneOptions& scene = arguments.scene;
  const RunOptions& run = arguments.run;
  if (const auto message = arguments.settle()) return tool::report_usage(*message);
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, run.n_threads());
  if (const int code = arguments.check_outputs(); code != tool::kSuccess) return code;
  const auto inputs = open_inputs(arguments);
  if (!inputs) return report_failure(inputs.error());
  if (const auto message = arguments.output.check_format(scene, arguments.output.format_of(scene.output())))
    return tool::report_usage(*message);
  std::string auditor;
  if (const int code = check_target(arguments, auditor); code != tool::kSuccess) return code;
  if (const int code = check_audit(arguments, auditor); code != tool::kSuccess) return code;
  if (const auto read = arguments.output.read_cameras(); !read) return report_failure(read.error());
  const auto summary = arguments.output.target.option() != nullptr
                           ? convert_to_target(arguments, inputs->scenes, auditor)
                           : convert_open(arguments, inputs->scenes, run.progress()).map_error(report_failure);
  if (!summary) return summary.error();
  run.print_summary(*summary, scene.output());
  return arguments.audit ? run_audit(arguments, auditor) : tool::kSuccess;
}

}  // namespace rgs
