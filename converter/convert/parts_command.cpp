// parts_command.cpp - runs the steps in order, for the inputs and ranges of this process.
// SPDX-License-Identifier: Apache-2.0
#include "parts_command.hpp"

#include <fmt/format.h>

#include <charconv>
#include <utility>

#include "console.hpp"
#include "convert_summary.hpp"
#include "input_files.hpp"

namespace rgs {
namespace {

int report_failure(const Failure& failure) {
  return tool::report(failure.file, failure.error);
}

class Steps {
 public:
  Steps(const PartsCommand& command, const Selection& selection) : command_(command), selection_(selection) {}

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
    if (!command_.quiet) tool::print(text);
  }

 private:
  const PartsCommand& command_;
  Selection selection_;
  int code_ = tool::kSuccess;
};

int selection_beyond(const std::string& text, std::size_t n, const char* of) {
  return tool::report_usage(fmt::format("--lod-input {}: there are {} {}, counted from 0", text, n, of));
}

int partition(const PartsCommand& command, const PartsRun& run, const Selection& selection,
              const std::function<Outcome<PartsJob>()>& describe) {
  auto described = describe ? describe() : open_job(run);
  if (!described) return report_failure(described.error());
  const auto job = describe ? begin_parts(run, *described, command.overwrite) : std::move(described);
  if (!job) return report_failure(job.error());
  const std::size_t n = job->inputs.size();
  if (selection.is_part && selection.last >= n) return selection_beyond(command.selected, n, "inputs");
  Steps steps(command, selection);
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

int build(const PartsCommand& command, const PartsRun& run, const Selection& selection) {
  const auto job = open_job(run);
  if (!job) return report_failure(job.error());
  if (selection.is_part && selection.last >= job->n_ranges)
    return selection_beyond(command.selected, job->n_ranges, "ranges");
  const auto plan = need_plan(run, *job);
  if (!plan) return report_failure(plan.error());
  Steps steps(command, selection);
  steps.each(job->n_ranges, "built", "ranges", [&](std::size_t i) { return build_range(run, *job, *plan, i); });
  return steps.code();
}

int assemble(const PartsCommand& command, const PartsRun& run, const std::string& output_path,
             const AtomicFile::Options& output) {
  const auto job = open_job(run);
  if (!job) return report_failure(job.error());
  const auto plan = need_plan(run, *job);
  if (!plan) return report_failure(plan.error());
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
  const auto summary = assemble_parts(run, *job, *plan, output_path, output);
  if (!summary) return report_failure(summary.error());
  if (command.json) {
    tool::print(summary_json(*summary));
  } else if (!command.quiet) {
    (output_path == "-" ? tool::print_error : tool::print)(summary_text(*summary));
  }
  return tool::kSuccess;
}

}  // namespace

const std::string& PartsCommand::folder() const {
  for (const std::string* folder : {&partition, &build, &assemble}) {
    if (!folder->empty()) return *folder;
  }
  return list;
}

std::optional<Selection> parse_selection(const std::string& text) {
  if (text == "all") return Selection{};
  if (text == "none") return Selection{1, 0, false};
  Selection selection{0, 0, true};
  const char *first = text.data(), *last = first + text.size();
  const auto begin = std::from_chars(first, last, selection.first);
  if (begin.ec != std::errc()) return std::nullopt;
  selection.last = selection.first;
  if (begin.ptr == last) return selection;
  if (*begin.ptr != '-') return std::nullopt;
  const auto end = std::from_chars(begin.ptr + 1, last, selection.last);
  if (end.ec != std::errc() || end.ptr != last || selection.last < selection.first) return std::nullopt;
  return selection;
}

int run_parts(const PartsCommand& command, const PartsRun& run, const std::function<Outcome<PartsJob>()>& describe,
              const std::string& output_path, const AtomicFile::Options& output) {
  const auto selection = parse_selection(command.selected);
  if (!selection)
    return tool::report_usage("--lod-input takes all, none, a number or a range such as 4-7, not '" + command.selected +
                              "'");
  if (!command.partition.empty()) return partition(command, run, *selection, describe);
  if (!command.build.empty()) return build(command, run, *selection);
  if (!command.assemble.empty()) return assemble(command, run, output_path, output);
  const auto list = list_parts(run);
  if (!list) return report_failure(list.error());
  tool::print(*list);
  return tool::kSuccess;
}

}  // namespace rgs
