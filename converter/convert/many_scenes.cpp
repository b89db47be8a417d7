// many_scenes.cpp - checks a batch before its first scene, and converts each as one_scene.cpp does.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/global_control.h>

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <utility>

#include "batch_plan.hpp"
#include "input_files.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/version.hpp"
#include "rgs_convert.hpp"

namespace rgs {
namespace {

namespace fs = std::filesystem;

Outcome<ConvertSummary> convert_share(const ConvertArguments& all, const BatchScene& scene, const BatchShare& share) {
  ConvertArguments arguments = all;
  arguments.scene.files = {scene.input, scene.output_path};
  arguments.output.convert.encode.archive.threads = share.threads;
  arguments.output.convert.output.overwrite = share.overwrite;
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, share.threads);
  const auto inputs = open_inputs(arguments);
  if (!inputs) return tl::unexpected(inputs.error());
  return convert_open(arguments, inputs->scenes, tool::Progress::Mode::quiet);
}

// Reads a whole scene, with all its levels.
Status check_whole(const std::string& path, const DecodeLimits& limits) {
  SceneInput input;
  if (Status s = input.open(path); !s) return s;
  if (has_levels(input.bytes())) {
    const auto paged = PagedFile::open(input.bytes(), limits);
    if (!paged) return tl::unexpected(paged.error());
    if (Status s = validate(*paged); !s) return s;
  }
  ReadOptions options;
  options.limits = limits;
  return input.read(options).map([](const SplatFile&) {});
}

// The inputs of many scenes and their output folder, or the exit code of a reported error.
tl::expected<BatchPlan, int> plan(const ConvertArguments& arguments, const std::string& list) {
  const std::vector<std::string>& files = arguments.scene.files;
  const SplatFormat to = arguments.output.to;
  const auto usage = [](const std::string& message) { return tl::unexpected(tool::report_usage(message)); };
  if (arguments.scene.merge) return usage("--merge takes files; each scene of a folder has its own output");
  if (arguments.audit) return usage("--audit takes one scene; run rgs-audit on the two folders afterwards");
  if (const char* option = arguments.output.target.option())
    return usage(std::string(option) + " takes one scene; convert each on its own");
  if (list.empty() && to == SplatFormat::unknown)
    return usage(files.front() + " is a folder; pass --to rgs, ply, spz, ... to convert all scenes in it");
  if (list.empty() && files.size() < 2) return usage(files.front() + " is a folder; name the output folder after it");
  if (files.size() > 2) return usage("give many scenes as one folder, or by --list");
  std::error_code ignored;
  if (files.size() == 2 && !fs::is_directory(files.front(), ignored))
    return usage("--list takes the output folder, optionally preceded by the input folder; " + files.front() +
                 " is not a folder");
  if (files.back() == "-" || files.front() == "-") return usage("many scenes need folders, not -");
  return plan_batch(list, files.size() == 2 ? files.front() : "", files.back(), to);
}

// "2/8": the second of eight.
void parse_shard(const std::string& text, BatchOptions& batch) {
  const char *first = text.data(), *last = first + text.size();
  const auto a = std::from_chars(first, last, batch.shard);
  const bool half = a.ec == std::errc() && a.ptr != last && *a.ptr == '/';
  const auto b = std::from_chars(half ? a.ptr + 1 : last, last, batch.n_shards);
  constexpr unsigned kMost = 100'000;
  if (b.ec != std::errc() || b.ptr != last || batch.shard < 1 || batch.shard > batch.n_shards || batch.n_shards > kMost)
    refuse_option("--shard takes I/N, such as 2/8, not '" + text + "'");
}

}  // namespace

void ManyScenes::add_to(CLI::App& app) {
  app.option_defaults()->group(kBatchGroup);
  app.add_option("--list", list,
                 "Convert the inputs in this file, one a line, optionally followed by a tab and its output; - for "
                 "standard input. With --lod-partition: more inputs")
      ->option_text("FILE");
  app.add_option("--jobs,-j", batch.jobs,
                 "Scenes converted in parallel [1]; threads and --memory are divided among them")
      ->check(CLI::Range(1, 1024));
  app.add_option_function<std::string>(
         "--shard", [this](const std::string& text) { parse_shard(text, batch); },
         "Convert part I of N, for N machines that share a folder")
      ->option_text("I/N");
  app.add_flag("--keep-going", batch.keep_going, "Go on after a scene that fails (default)");
  app.add_flag_callback(
         "--no-keep-going", [this] { batch.keep_going = false; }, "Start no further scene after one fails")
      ->excludes("--keep-going");
  app.add_flag("--overwrite-damaged", overwrite_damaged,
               "Read every existing output, and replace those that are damaged or cut off");
  app.add_option("--report", batch.report, "Write each scene's line of JSON to this file instead of standard output")
      ->option_text("FILE");
}

int ManyScenes::convert(ConvertArguments& arguments) {
  SceneOptions& scenes = arguments.scene;
  OutputOptions& output = arguments.output;
  const RunOptions& run = arguments.run;
  auto planned = plan(arguments, list);
  if (!planned) return planned.error();
  if (const auto message = arguments.settle()) return tool::report_usage(*message);
  if (output.limits_memory && !output.levels) return tool::report_usage("--memory and --scratch require --lod");
  for (const BatchScene& scene : planned->scenes) {
    if (const auto message = output.check_format(scenes, output.format_of(scene.output_path)))
      return tool::report_usage(output.to != SplatFormat::unknown ? *message : scene.output + ": " + *message);
  }
  // Checks all shards' scenes, so that all machines agree.
  if (const std::string clash = outputs_that_clash(*planned, scenes.output()); !clash.empty())
    return tool::report_usage(clash);
  std::vector<std::string> outputs{batch.report};
  tool::InputFiles inputs;
  inputs.add_cameras(output.cameras);
  inputs.add(list);
  for (const BatchScene& scene : planned->scenes) {
    inputs.add_scene(scene.input);
    outputs.push_back(scene.output_path);
  }
  for (std::string& state : state_files(scenes.output(), batch)) outputs.push_back(std::move(state));
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  if (const auto read = output.read_cameras(); !read) return report_failure(read.error());
  if (planned->scenes.empty())
    return tool::report_usage(list.empty() ? "no scene in " + scenes.files.front() : "no scene is named in " + list);
  batch.threads = run.n_threads();
  const std::uint64_t memory = output.convert.memory_bytes / batch.jobs;
  if (memory < lod::kLeastMemory && output.memory_bytes)
    return tool::report_usage("--memory is divided among --jobs; each needs at least 128MiB");
  output.convert.memory_bytes = std::max(memory, lod::kLeastMemory);
  batch.out = scenes.output();
  if (batch.report == "-") batch.report.clear();
  if (const int code = make_folder(batch.out); code != tool::kSuccess) return code;  // the report may lie there
  if (!batch.report.empty()) {
    if (const Status s = check_report(batch.report, output.convert.output.overwrite); !s)
      return tool::report(batch.report, s.error());
  }
  batch.tool = "rgs-convert " RGS_VERSION;
  if (overwrite_damaged)
    batch.check_output = [&scenes](const std::string& path) { return check_whole(path, scenes.limits); };
  batch.sync = output.convert.output.sync;
  batch.overwrite = output.convert.output.overwrite;
  batch.quiet = run.quiet;
  batch.json = run.json;
  batch.n_others = planned->n_others;
  if (!run.quiet) {
    for (const std::string& link : planned->refused)
      tool::print_error("rgs-convert: " + tool::printable(link) + ": a link to a folder that contains it, ignored\n");
  }
  const auto hash = options_hash(arguments.given, output.cameras);
  if (!hash) return tool::report(output.cameras, hash.error());
  batch.options_hash = *hash;
  return run_batch(scenes_of_shard(std::move(planned->scenes), batch.shard, batch.n_shards), batch,
                   [&arguments](const BatchScene& scene, const BatchShare& share) {
                     return convert_share(arguments, scene, share);
                   });
}

}  // namespace rgs
