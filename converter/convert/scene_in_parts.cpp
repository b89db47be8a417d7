// scene_in_parts.cpp - describes the job, and runs the steps in order for the inputs and ranges of this process.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <filesystem>
#include <iterator>
#include <utility>

#include "batch_plan.hpp"
#include "input_files.hpp"
#include "rgs/version.hpp"
#include "rgs_convert.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;

// The job for these inputs and options; opens one file at a time.
Outcome<PartsJob> describe_job(const SceneOptions& scene, OutputOptions& output, const SceneInParts& parts,
                               const std::string& cameras_hash) {
  PartsJob job;
  EncodeOptions& encode = output.convert.encode;
  std::vector<InputDeclarations> declared;
  std::vector<Origin> origins;
  std::uint64_t file_bytes = 0;
  for (std::size_t i = 0; i < scene.n_inputs(); ++i) {
    PartsInput& part = job.inputs.emplace_back();
    SceneInput input;
    if (const Status s = input.open(scene.files[i]); !s) return failed(scene.files[i], s.error());
    auto opened = open_tile(scene, input, i, job.notes);
    if (!opened) return tl::unexpected(opened.error());
    if (i == 0) encode.axes = scene.target_axes(opened->tile.axes, opened->format, SplatFormat::rgs);
    const auto facts = tile_facts(opened->tile, encode.axes);
    if (!facts) return failed(input.path(), facts.error());
    std::error_code ignored;
    part = {fs::absolute(input.path(), ignored).string(),
            input.name(),
            input.bytes().size(),
            hash_of_prefix(input.bytes()),
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
  encode.origin = merged_origin(origins);
  const std::string& first = scene.files.front();
  if (job.inputs.size() == 1 && job.inputs.front().format == SplatFormat::rgs) {
    return failed(first,
                  {Errc::bad_argument, Error::kNone, "a single .rgs is converted in one process; run rgs-convert --lod",
                   Error::kNone, Error::kNone, 0});
  }
  if (const Status s = check_count(job.n); !s) return failed(first, s.error());
  if (auto s = declare_scene(encode, declared, scene.asked, job.notes); !s) return failed(first, s.error());
  const std::string name = job.inputs.front().name + (job.inputs.size() == 1 ? "" : " and more");
  encode.provenance = Provenance{file_bytes, 0, name, "rgs-convert " RGS_VERSION};
  encode.n_source = job.n;
  encode.n_repaired = 0;
  if (const Status s = check_encodable(SceneScan(0), encode); !s) return failed(first, s.error());
  job.source_format = job.inputs.size() == 1 ? format_name(job.inputs.front().format) : "merged";
  job.read = scene.read_options();
  job.encode = encode;
  job.quality = *output.convert.levels;
  job.n_ranges = parts.n_ranges;
  job.bin_rows = choose_bin_rows(encode, job.output_degree(), output.convert.memory_bytes);
  std::error_code ignored;
  if (!output.cameras.empty()) job.cameras = fs::absolute(output.cameras, ignored).string();
  job.cameras_hash = cameras_hash;
  job.z_near = output.convert.z_near;
  job.z_far = output.convert.z_far;
  job.strict = output.convert.strict;
  job.allow_rounding = output.convert.allow_rounding;
  return job;
}

// Rejects what parts cannot do; returns the message for the user.
std::optional<std::string> check_parts(const ConvertArguments& a, const SceneInParts& parts, bool begins) {
  const SceneOptions& scene = a.scene;
  if (begins) {
    if (parts.n_ranges == 0)
      return "--lod-partition with inputs requires --ranges N, the number of processes that may build";
    if (const char* option = a.output.target.option())
      return std::string(option) + " needs all Gaussians at once; convert in one process with --lod";
    if (a.output.on_cuda) return "--backend cuda requires one process with --lod";
    if (a.output.convert.encode.order == Order::input)
      return "parts are ranges of the Morton curve; --keep-order requires one process with --lod";
    if (!scene.filter.keeps_all() || scene.level_of_detail)
      return "--crop, --min-opacity, --max-count and --level-of-detail need all Gaussians in memory; apply them "
             "before";
    if (a.audit) return "--audit compares two files; run rgs-audit afterwards";
    if (std::ranges::count(scene.inputs(), "-") != 0)
      return "several processes read the inputs; name files instead of -";
    return std::nullopt;
  }
  if (!a.given.empty() || !a.output.cameras.empty() || parts.n_ranges != 0)
    return "the work keeps the options that it began with; give them to --lod-partition together with the "
           "inputs";
  if (parts.step == "--lod-assemble") {
    if (scene.files.size() != 1) return "--lod-assemble FOLDER takes one output";
  } else if (parts.step == "--lod-partition") {
    if (a.output.convert.output.overwrite) return "--overwrite begins again; it requires the inputs";
  } else if (!scene.files.empty()) {
    return "the folder of the work suffices; drop " + scene.files.front();
  }
  if (a.output.memory_bytes && *a.output.memory_bytes < lod::kLeastMemory) return "--memory must be at least 128MiB";
  return std::nullopt;
}

// Rejects an option that the command would ignore; returns the message for the user.
std::optional<std::string> check_parts_options(const CLI::App& app, const SceneInParts& parts) {
  const bool partitions = parts.step == "--lod-partition", assembles = parts.step == "--lod-assemble";
  const auto has_effect = [&](const CLI::Option& option) {
    const std::string& name = option.get_name();
    if (name == "--list") return partitions;
    if (name == "--json") return assembles || parts.step == "--lod-list";
    if (name == "--overwrite") return assembles || partitions;
    if (name == "--lod-input") return partitions || parts.step == "--lod-build";
    return option.get_group() != kBatchGroup;
  };
  for (const CLI::Option* option : app.get_options()) {
    if (option->count() != 0 && !has_effect(*option)) return option->get_name() + " has no effect on " + parts.step;
  }
  return std::nullopt;
}

class Steps {
 public:
  Steps(const Selection& selection, bool quiet) : selection_(selection), quiet_(quiet) {}

  int code() const { return code_; }

  // Calls a step for each selected one of n; a failure does not stop the others.
  template <class Step>
  void each(std::size_t n, const char* what, const char* of, const Step& step) {
    std::size_t n_done = 0, n_there = 0, n_failed = 0;
    for (std::size_t i = selection_.first; i < n && i <= selection_.last; ++i) {
      const Done done = step(i);
      if (!done) {
        code_ = tool::worse_exit_code(code_, report_failure(done.error()));
        ++n_failed;
      } else {
        ++(*done ? n_done : n_there);
      }
    }
    if (n_done + n_there + n_failed == 0) return;
    say(fmt::format("{} {} of {} {}{}{}\n", what, n_done, n, of,
                    n_there == 0 ? "" : fmt::format(", {} done before", n_there),
                    n_failed == 0 ? "" : fmt::format(", {} failed", n_failed)));
  }
  void say(const std::string& text) const {
    if (!quiet_) tool::print(text);
  }

 private:
  Selection selection_;
  bool quiet_;
  int code_ = tool::kSuccess;
};

int selection_beyond(const std::string& text, std::size_t n, const char* of) {
  return tool::report_usage(fmt::format("--lod-input {}: there are {} {}, counted from 0", text, n, of));
}

int place_inputs(const SceneInParts& parts, const PartsRun& run, const Outcome<PartsJob>& job, bool quiet) {
  const Selection& selection = parts.selection;
  if (!job) return report_failure(job.error());
  const std::size_t n = job->inputs.size();
  if (selection.is_part && selection.last >= n) return selection_beyond(selection.text, n, "inputs");
  Steps steps(selection, quiet);
  steps.each(n, "scanned", "inputs", [&](std::size_t i) { return scan_input(run, *job, i); });
  if (steps.code() != tool::kSuccess) return steps.code();
  std::size_t n_missing = 0;
  if (!selection.is_part) {
    for (std::size_t i = 0; i < n; ++i) {
      const auto scan = WorkFile::find(run.scan_path(i), WorkKind::scan, job->identity);
      if (!scan || !*scan) ++n_missing;
    }
    if (n_missing == 0) {
      const Done planned = make_plan(run, *job);
      if (!planned) return report_failure(planned.error());
    } else {
      steps.say(fmt::format("no plan yet: {} of {} inputs are not scanned\n", n_missing, n));
    }
  }
  const auto plan = find_plan(run, *job);
  if (!plan) return report_failure(plan.error());
  if (!*plan) {
    if (selection.is_part)
      steps.say(
          "no plan yet: once all inputs are scanned, run --lod-input none to plan, then this command to place these\n");
    return tool::kSuccess;
  }
  const std::size_t n_stretches = stretches_of(run, *job, **plan).size() - 1;
  if (!selection.is_part && n_stretches < job->n_ranges)
    steps.say(fmt::format("{} of {} ranges are empty: the scene has {} stretch{}\n", job->n_ranges - n_stretches,
                          job->n_ranges, n_stretches, n_stretches == 1 ? "" : "es"));
  steps.each(n, "placed", "inputs", [&](std::size_t i) { return place_input(run, *job, **plan, i); });
  return steps.code();
}

Outcome<PartsPlan> need_plan(const PartsRun& run, const PartsJob& job) {
  auto plan = find_plan(run, job);
  if (!plan) return tl::unexpected(plan.error());
  if (*plan) return std::move(**plan);
  return failed(run.plan_path(),
                {Errc::open_failed, Error::kNone, "missing, or from other scans; complete --lod-partition first",
                 Error::kNone, Error::kNone, 0});
}

int build_ranges(const SceneInParts& parts, const PartsRun& run, bool quiet) {
  const Selection& selection = parts.selection;
  const auto job = open_job(run);
  if (!job) return report_failure(job.error());
  if (selection.is_part && selection.last >= job->n_ranges)
    return selection_beyond(selection.text, job->n_ranges, "ranges");
  const auto plan = need_plan(run, *job);
  if (!plan) return report_failure(plan.error());
  Steps steps(selection, quiet);
  steps.each(job->n_ranges, "built", "ranges", [&](std::size_t i) { return build_range(run, *job, *plan, i); });
  return steps.code();
}

int assemble_file(const PartsRun& run, const ConvertArguments& arguments) {
  const std::string& output_path = arguments.scene.output();
  const auto job = open_job(run);
  if (!job) return report_failure(job.error());
  auto plan = need_plan(run, *job);
  if (!plan) return report_failure(plan.error());
  plan->encode.archive.threads = arguments.run.n_threads();
  tool::InputFiles inputs;
  for (const PartsInput& input : job->inputs) inputs.add_scene(input.path);
  inputs.add(run.job_path());
  inputs.add(run.plan_path());
  for (std::size_t i = 0; i < job->inputs.size(); ++i) {
    inputs.add(run.scan_path(i));
    inputs.add(run.rows_path(i));
  }
  for (std::size_t i = 0; i < job->n_ranges; ++i) inputs.add(run.range_path(i));
  if (const int code = inputs.check_outputs({&output_path, 1}); code != tool::kSuccess) return code;
  const auto summary = assemble_parts(run, *job, *plan, output_path, arguments.output.convert.output);
  if (!summary) return report_failure(summary.error());
  arguments.run.print_summary(*summary, output_path);
  return tool::kSuccess;
}

}  // namespace

void SceneInParts::add_to(CLI::App& app) {
  app.option_defaults()->group(kPartsGroup);
  std::vector<CLI::Option*> before;
  const auto add_step = [&](const char* name, const char* text) {
    const auto choose = [this, name](const std::string& path) {
      step = name;
      folder = path;
    };
    CLI::Option* option = app.add_option_function<std::string>(name, choose, text)->option_text("FOLDER");
    for (CLI::Option* other : before) option->excludes(other);
    before.push_back(option);
  };
  add_step("--lod-partition",
           "Begin or continue in this folder to convert the inputs as --lod does: scan them, plan, place their "
           "Gaussians by range");
  add_step("--lod-build", "Then build the levels of ranges");
  add_step("--lod-assemble", "Then assemble them into one .rgs, the output");
  add_step("--lod-list", "Print as JSON the inputs and ranges, and what is done");
  app.add_option("--ranges", n_ranges, "Number of ranges; the output does not depend on it")
      ->check(CLI::Range(1, 65536));
  app.add_option_function<std::string>(
         "--lod-input",
         [this](const std::string& text) {
           const auto parsed = parse_selection(text);
           if (!parsed)
             refuse_option("--lod-input takes all, none, a number or a range such as 4-7, not '" + text + "'");
           selection = *parsed;
         },
         "Inputs or ranges of this process, from 0: K, K-M, all, none [all]; all and none also plan")
      ->option_text("K|K-M|all|none");
}

int SceneInParts::convert(const CLI::App& app, ConvertArguments& arguments, const std::string& input_list) const {
  SceneOptions& scene = arguments.scene;
  OutputOptions& output = arguments.output;
  if (const auto message = check_parts_options(app, *this)) return tool::report_usage(*message);
  const bool partitions = step == "--lod-partition";
  if (partitions && !input_list.empty()) {
    const auto lines = lines_of(input_list);
    if (!lines) return tool::report(input_list, lines.error());
    std::ranges::copy_if(*lines, std::back_inserter(scene.files),
                         [](const std::string& line) { return !line.empty(); });
    if (scene.files.empty()) return tool::report_usage("no input is named in " + input_list);
  }
  const bool begins = partitions && !scene.files.empty();
  if (partitions) scene.files.push_back(folder + "/job");
  if (const auto message = check_parts(arguments, *this, begins)) return tool::report_usage(*message);
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, arguments.run.n_threads());
  tool::Progress progress(arguments.run.progress());
  PartsRun run;
  run.folder = folder;
  run.memory_bytes = output.memory_bytes.value_or(lod::kDefaultMemory);
  run.scratch = output.convert.scratch.empty() || begins ? run.folder : output.convert.scratch;
  run.sync = output.convert.output.sync;
  run.observer = observe(progress);
  if (begins) {
    output.levels = scene.merge = true;
    if (const auto message = arguments.settle()) return tool::report_usage(*message);
    if (const int code = arguments.check_outputs(); code != tool::kSuccess) return code;
    const auto hash = options_hash({}, output.cameras);  // all other options are in the job itself
    if (!hash) return tool::report(output.cameras, hash.error());
    const auto job = describe_job(scene, output, *this, *hash);
    if (!job) return report_failure(job.error());
    return place_inputs(*this, run, begin_parts(run, *job, output.convert.output.overwrite), arguments.run.quiet);
  }
  if (partitions) return place_inputs(*this, run, open_job(run), arguments.run.quiet);
  if (step == "--lod-build") return build_ranges(*this, run, arguments.run.quiet);
  if (step == "--lod-assemble") return assemble_file(run, arguments);
  const auto listed = list_parts(run);
  if (!listed) return report_failure(listed.error());
  tool::print(*listed);
  return tool::kSuccess;
}

}  // namespace rgs
