// rgs_audit.cpp - rgs-audit: size and quality of a conversion. Arguments and exit codes; audit_*.cpp do the work.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "audit.hpp"
#include "audit_folder.hpp"
#include "audit_gate.hpp"
#include "audit_json.hpp"
#include "audit_junit.hpp"
#include "audit_report.hpp"
#include "audit_text.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "rgs/file.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "spz_axes.hpp"

namespace {

namespace audit = rgs::audit;
namespace fs = std::filesystem;
namespace tool = rgs::tool;

struct Arguments {
  audit::Options audit;
  std::string size, report, json, junit;
  std::vector<std::string> conditions, measures;
  bool no_render = false, no_attribution = false, no_distances = false, overwrite = false, quiet = false;
};

int report_failure(const audit::Failure& failure) {
  return tool::report(failure.subject, failure.error);
}

bool prints_text(const Arguments& a) {
  return !a.quiet && a.json != "-" && a.report != "-";
}

int report_gate(const std::vector<audit::Condition>& gate) {
  for (const audit::Condition& c : gate)
    if (!c.holds) tool::print_error(fmt::format("rgs-audit: condition failed: {}\n", audit::describe(c)));
  return audit::holds(gate) ? tool::kSuccess : tool::kGate;
}

std::string read_text(const std::string& path) {
  const auto file = rgs::MappedFile::open(path);
  return file ? std::string(reinterpret_cast<const char*>(file->bytes().data()), file->bytes().size()) : std::string();
}

// Replaces an earlier one without asking: CI systems expect it under one name.
bool may_replace_junit(const Arguments& a) {
  return a.overwrite || audit::is_junit_of_audit(read_text(a.junit));
}

int write_junit(const Arguments& a, const audit::FolderRow& row) {
  if (a.junit.empty()) return tool::kSuccess;
  const auto ok = audit::write_text(a.junit, audit::junit_xml({&row, 1}), may_replace_junit(a));
  return ok ? tool::kSuccess : tool::report(a.junit, ok.error());
}

// Ends the audit early and removes an earlier JUnit file, which must not keep reporting success.
int fail(const Arguments& a, const audit::Failure& failure) {
  const int written =
      write_junit(a, audit::failed_row(rgs::detail::path_of(a.audit.asset).filename().string(), failure));
  return tool::worse_exit_code(report_failure(failure), written);
}

// The JSON file last: it says that the audit is done.
int write_outputs(const audit::Report& report, const Arguments& a, bool replaces_page) {
  if (!a.report.empty())
    if (const auto ok = audit::write_text(a.report, audit::audit_html(report), replaces_page); !ok)
      return fail(a, {a.report, ok.error()});
  if (!a.json.empty())
    if (const auto ok = audit::write_text(a.json, audit::audit_json(report), a.overwrite); !ok)
      return fail(a, {a.json, ok.error()});
  if (prints_text(a)) tool::print(audit::audit_text(report, a.report));
  return tool::kSuccess;
}

rgs::Status is_free(const std::string& path, bool overwrite) {
  if (path.empty() || path == "-") return {};
  return rgs::AtomicFile::create(path, {.overwrite = overwrite, .sync = false}).map([](const rgs::AtomicFile&) {});
}

int check_free(const std::string& path, bool overwrite) {
  const auto free = is_free(path, overwrite);
  return free ? tool::kSuccess : tool::report(path, free.error());
}

// Earlier results of the same inputs and options: --json, and --report if requested.
struct Earlier {
  audit::EarlierAudit audit;
  std::optional<std::string> page;
};
std::optional<Earlier> earlier(const Arguments& a, const std::vector<audit::Condition>& conditions) {
  std::error_code ignored;
  if (a.json.empty() || a.json == "-" || a.report == "-" || !fs::exists(rgs::detail::path_of(a.json), ignored))
    return {};
  const auto fingerprint = audit::fingerprint(a.audit);
  if (!fingerprint) return {};
  auto known = audit::earlier_audit(a.json, *fingerprint, conditions);
  if (!known) return {};
  Earlier out{*std::move(known), {}};
  if (a.report.empty()) return out;
  out.page = audit::with_gate(read_text(a.report), *fingerprint, out.audit.verdict, out.audit.gate);
  if (!out.page) return {};
  return out;
}

int report_earlier(const Earlier& earlier, const Arguments& a) {
  const audit::EarlierAudit& audit = earlier.audit;
  if (earlier.page)
    if (const auto ok = audit::write_text(a.report, *earlier.page, true); !ok) return fail(a, {a.report, ok.error()});
  if (audit.changed)
    if (const auto ok = audit::write_text(a.json, audit.json, true); !ok) return fail(a, {a.json, ok.error()});
  audit::FolderRow row;
  row.stem = rgs::detail::path_of(a.audit.asset).filename().string();
  row.gate = audit.gate;
  row.headline = audit.verdict.headline;
  row.status = audit::holds(audit.gate) ? audit::FolderRow::Status::passed : audit::FolderRow::Status::gate_failed;
  row.seconds = audit.seconds;
  if (const int code = write_junit(a, row); code != tool::kSuccess) return code;
  if (prints_text(a)) {
    for (const audit::Condition& c : audit.gate)
      tool::print(fmt::format("  {}      {}\n", c.holds ? "holds " : "FAILED", audit::describe(c)));
    tool::print(fmt::format("{}. {}\nas measured before: {}\n", tool::printable(audit.verdict.headline),
                            tool::printable(audit.verdict.detail), tool::printable(a.json)));
  }
  return report_gate(audit.gate);
}

// A page of the same inputs without its JSON file is left by a killed run.
bool may_replace_page(const Arguments& a) {
  std::error_code ignored;
  if (a.overwrite) return true;
  if (a.json.empty() || a.json == "-" || fs::exists(rgs::detail::path_of(a.json), ignored)) return false;
  const std::string page = a.report == "-" ? "" : read_text(a.report);
  if (!audit::is_audit_page(page)) return false;
  const auto fingerprint = audit::fingerprint(a.audit);
  return fingerprint && audit::is_audit_page_of(page, *fingerprint);
}

tool::InputFiles common_inputs(const Arguments& a) {
  tool::InputFiles inputs;
  inputs.add_cameras(a.audit.cameras);
  inputs.add_pictures(a.audit.photos);
  for (const std::string& also : a.audit.also) inputs.add_scene(also);
  return inputs;
}

int audit_pair(Arguments& a, std::vector<audit::Condition> conditions) {
  tool::InputFiles inputs = common_inputs(a);
  inputs.add_scene(a.audit.source);
  inputs.add_scene(a.audit.asset);
  const std::array<std::string, 4> outputs{a.report, a.json, a.junit, prints_text(a) ? "-" : ""};
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  if (const int code = check_free(a.junit, may_replace_junit(a)); code != tool::kSuccess) return code;
  if (const auto known = earlier(a, conditions)) {
    if (const auto changed = inputs.changed()) return fail(a, {*changed, tool::kFileChanged});
    return report_earlier(*known, a);
  }
  const bool replaces_page = may_replace_page(a);
  if (const auto free = is_free(a.report, replaces_page); !free) return fail(a, {a.report, free.error()});
  if (const auto free = is_free(a.json, a.overwrite); !free) return fail(a, {a.json, free.error()});
  audit::Outcome<audit::Report> report;
  {
    tool::Progress progress(a.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    report = audit::run(a.audit, progress);
  }
  // A change of a file explains any other error.
  if (const auto changed = inputs.changed()) return fail(a, {*changed, tool::kFileChanged});
  if (!report) return fail(a, report.error());
  const auto fingerprint = audit::fingerprint(a.audit);
  if (!fingerprint) return fail(a, fingerprint.error());
  report->fingerprint = *fingerprint;
  if (const auto changed = inputs.changed()) return fail(a, {*changed, tool::kFileChanged});  // since the fingerprint
  audit::evaluate(std::move(conditions), *report);
  if (const int code = write_outputs(*report, a, replaces_page); code != tool::kSuccess) return code;
  if (const int code = write_junit(a, audit::row_of(*report)); code != tool::kSuccess) return code;
  return report_gate(report->gate);
}

// Pairs are read and written by stem.
int check_folders(const Arguments& a) {
  tool::InputFiles inputs = common_inputs(a);
  const auto pairs = audit::pairs_of(a.audit);
  if (!pairs) {
    if (const int code = inputs.check_outputs({&a.junit, 1}); code != tool::kSuccess) return code;
    return fail(a, pairs.error());
  }
  std::error_code ignored;
  const fs::path out = rgs::detail::path_of(a.report), cameras = rgs::detail::path_of(a.audit.cameras),
                 photos = rgs::detail::path_of(a.audit.photos);
  std::vector<std::string> outputs{a.junit};
  for (const char* name : {"index.csv", "index.json", "index.html"}) outputs.push_back((out / name).string());
  for (const auto& [stem, pair] : *pairs) {
    inputs.add_scene(pair.source);
    inputs.add_scene(pair.asset);
    const fs::path own = cameras / rgs::detail::path_of(stem + ".json");
    if (!cameras.empty() && fs::exists(own, ignored)) inputs.add(own.string());
    if (!photos.empty()) inputs.add_pictures((photos / rgs::detail::path_of(stem)).string());
    // audit_folder() rejects a pair named like the tables and writes nothing.
    if (stem == "index") continue;
    for (const char* extension : {".json", ".html"})
      outputs.push_back((out / rgs::detail::path_of(stem + extension)).string());
  }
  return inputs.check_outputs(outputs);
}

int audit_pairs(const Arguments& a, std::vector<audit::Condition> conditions) {
  if (a.report.empty() || a.report == "-")
    return tool::report_usage("two folders require a folder for the reports: --report FOLDER");
  if (!a.json.empty())
    return tool::report_usage("with two folders, JSON goes into the folder of --report; drop --json");
  if (!a.audit.also.empty()) return tool::report_usage("--also requires one pair, not two folders");
  if (const int code = check_folders(a); code != tool::kSuccess) return code;
  std::error_code failed;
  fs::create_directories(rgs::detail::path_of(a.report), failed);  // --junit may lie there
  if (failed)
    return tool::report(a.report, {rgs::Errc::write_failed, rgs::Error::kNone, "cannot create the folder",
                                   rgs::Error::kNone, rgs::Error::kNone, failed.value()});
  if (const int code = check_free(a.junit, may_replace_junit(a)); code != tool::kSuccess) return code;
  const auto rows = audit::audit_folder({a.audit, std::move(conditions), a.report, a.junit, a.overwrite, a.quiet});
  if (!rows) return fail(a, rows.error());
  for (const audit::FolderRow& row : *rows)
    if (row.exit_code != tool::kSuccess)
      tool::print_error(fmt::format("rgs-audit: {}: {}\n", tool::printable(row.stem),
                                    tool::printable(row.error.empty() ? row.headline : row.error)));
  if (!a.quiet)
    tool::print(fmt::format("table: {}\n", tool::printable((rgs::detail::path_of(a.report) / "index.html").string())));
  return audit::exit_code_of(*rows);
}

int audit_main(Arguments& a) {
  a.audit.render = !a.no_render;
  a.audit.attribution = !a.no_attribution;
  a.audit.distances = !a.no_distances;
  if (!a.size.empty()) {
    const auto size = tool::parse_size(a.size);
    if (!size) return tool::report_usage("--size takes WxH, sides 1 to 65536, not '" + a.size + "'");
    a.audit.size = *size;
  }
  std::vector<audit::Condition> conditions;
  for (const std::string& text : a.conditions) {
    auto parsed = audit::parse_conditions(text);
    if (!parsed) return tool::report_usage(parsed.error());
    conditions.insert(conditions.end(), parsed->begin(), parsed->end());
  }
  for (std::size_t i = 0; i < audit::kMeasures.size(); ++i)
    a.audit.measures[i] = std::ranges::find(a.measures, audit::kMeasures[i].name) != a.measures.end();
  audit::imply(conditions, a.audit);
  if (!a.measures.empty() && a.no_render) return tool::report_usage("--measures needs pictures; drop --no-render");
  if (const std::string wrong = audit::unmeasurable(conditions, a.audit); !wrong.empty())
    return tool::report_usage(wrong);
  if (!a.audit.photos.empty() && a.audit.cameras.empty())
    return tool::report_usage("--photos requires --cameras, which took them");
  if (a.audit.video && a.no_render) return tool::report_usage("--video needs pictures; drop --no-render");
  if (a.json == "-" && a.report == "-") return tool::report_usage("--json - and --report - both need standard output");
  const std::size_t threads = a.audit.threads > 0 ? static_cast<std::size_t>(a.audit.threads)
                                                  : std::max(1u, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
  std::error_code ignored;
  const bool folders = fs::is_directory(rgs::detail::path_of(a.audit.source), ignored);
  if (folders != fs::is_directory(rgs::detail::path_of(a.audit.asset), ignored))
    return tool::report_usage("source and asset must be two files or two folders");
  return folders ? audit_pairs(a, std::move(conditions)) : audit_pair(a, std::move(conditions));
}

void add_options(CLI::App& app, Arguments& a) {
  audit::Options& o = a.audit;
  std::string names;
  for (const audit::ConditionKind& kind : audit::condition_kinds())
    names += fmt::format("\n  {:<24}{} {}", kind.name, kind.at_least ? "at least:" : "at most: ", kind.meaning);
  app.add_option("source", o.source, "Source of the asset: " + rgs::format_list() + "; or a folder of these")
      ->required();
  app.add_option("asset", o.asset,
                 "Asset made from it, in any of these formats; or a folder of files with the same names")
      ->required();
  app.add_option("--cameras,-c", o.cameras, "Views to compare: camera file or COLMAP folder (docs/user/CAMERAS.md)");
  app.add_option("--photos", o.photos, "Folder of the cameras' photographs, by name")->needs("--cameras");
  app.add_option("--report,-o", a.report, "Write the report as one HTML file; for two folders, a folder");
  app.add_option("--json", a.json, "Write the results as JSON (docs/user/AUDIT_JSON.md); - for standard output");
  app.add_option("--junit", a.junit, "Write each condition of each scene as a JUnit XML test case, for CI systems")
      ->option_text("FILE");
  app.add_option("--fail-below", a.conditions, "Conditions such as psnr=50,loss=0.03; exit code 5 if one does not hold")
      ->option_text("NAME=LIMIT,...");
  app.add_option("--also", o.also, "Another file of the same scene to measure like the asset; may be repeated")
      ->option_text("FILE");
  app.add_flag("--overwrite", a.overwrite, "Replace existing outputs");

  const std::string views = "Views";
  app.add_option("--split", o.split, "Cameras of the file [test if it has more than 32, else all]")
      ->check(CLI::IsMember({"train", "test", "all"}))
      ->group(views);
  app.add_option("--size", a.size, "WxH pixels of every view [the camera's own; 1280x720 without cameras]")
      ->group(views);
  app.add_option("--views", o.views, "Views on a circle around a scene without cameras")
      ->check(CLI::Range(1, 10000))
      ->capture_default_str()
      ->excludes("--cameras")
      ->group(views);
  app.add_option("--worst", o.worst,
                 "And the N worst views of a search behind, below and inside it and where levels switch; 0: no search")
      ->check(CLI::Range(0, 1000))
      ->capture_default_str()
      ->excludes("--cameras")
      ->group(views);
  app.add_flag("--depth", o.depth, "Also compare expected depths, where both draw at least half of a pixel")
      ->group(views);
  app.add_option("--measures", a.measures, "Further measures of the views; conditions on them imply them")
      ->delimiter(',')
      ->check(CLI::IsMember({"flip", "ms-ssim", "gmsd"}))
      ->option_text("flip,ms-ssim,gmsd")
      ->group(views);
  app.add_flag("--video", o.video,
               "The cameras are frames in their order: also curves, worst seconds and flicker; --split is all")
      ->needs("--cameras")
      ->group(views);
  app.add_option("--fps", o.fps, "Frames of a second of the video")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str()
      ->needs("--video")
      ->group(views);
  app.add_flag("--no-render", a.no_render, "Compare sizes and attributes only")->group(views);
  app.add_flag("--no-attribution", a.no_attribution, "Do not attribute the loss to steps")->group(views);
  app.add_flag("--no-distances", a.no_distances, "Do not compare levels of detail from ever farther away")
      ->group(views);
  app.add_flag("--compare-scales", o.compare_scales,
               "Also compare SH with one scale set for the file and one per chunk")
      ->group(views);

  const std::string machine = "Machine";
  app.add_option("--backend", o.backend, "Renderer: auto, cpu, cuda [auto]")
      ->transform(tool::one_of<rgs::Backend>(
          {{"auto", rgs::Backend::automatic}, {"cpu", rgs::Backend::cpu}, {"cuda", rgs::Backend::cuda}}))
      ->group(machine);
  app.add_option("--threads", o.threads, "Threads, 0 for all cores")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str()
      ->group(machine);
  tool::add_max_expansion(app, o.read.limits)->group(machine);
  tool::add_spz_axes(app, o.read.spz_axes);
  app.add_flag("--quiet,-q", a.quiet, "No progress, no summary")->group(machine);
  app.set_version_flag("--version", "rgs-audit " RGS_VERSION);
  app.footer(
      "Conditions of --fail-below:" + names +
      "\nExit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input, 5 a condition failed, "
      "6 a file with levels of detail is cut off. Two folders return the worst, in this order: 1, 3, 2, 4, 6, 5.");
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Arguments arguments;
    CLI::App app{"Audits a conversion: size, attribute error and rendered quality of an asset against its source.",
                 "rgs-audit"};
    add_options(app, arguments);
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    return audit_main(arguments);
  });
}
