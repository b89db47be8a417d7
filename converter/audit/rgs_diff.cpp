// rgs_diff.cpp - rgs-diff: what differs between two splat files. Arguments and exit codes; diff.cpp does the work.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/global_control.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <thread>
#include <vector>

#include "audit_folder.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "diff.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "spz_axes.hpp"

namespace {

namespace audit = rgs::audit;
namespace tool = rgs::tool;

// As those of diff; a bug of the program is none of its answers.
constexpr int kDifferent = 1, kBug = 7;

struct Arguments {
  std::string a, b, json, ply, pictures, size;
  audit::Options views;  // cameras, their split and size
  rgs::ReadOptions read;
  double tolerance = 0;
  int threads = 0;
  bool overwrite = false, quiet = false;
};

// Fails early instead of after the work.
int check_outputs(const Arguments& o, const tool::InputFiles& inputs, bool prints_text) {
  if (o.ply == "-") return tool::report_usage("--ply writes a file, not to standard output");
  std::vector<std::string> outputs{o.json, o.ply, prints_text ? "-" : ""};
  if (!o.pictures.empty()) {
    const auto paths = audit::difference_paths(o.pictures, o.views);
    if (!paths) return tool::report(paths.error().subject, paths.error().error);
    outputs.insert(outputs.end(), paths->begin(), paths->end());
  }
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  for (const std::string& output : outputs) {
    std::error_code ignored;
    if (!output.empty() && output != "-" && !o.overwrite &&
        std::filesystem::exists(rgs::detail::path_of(output), ignored))
      return tool::report(
          output, {rgs::Errc::output_exists, rgs::Error::kNone, "the output exists; pass --overwrite to replace it"});
  }
  return tool::kSuccess;
}

int compare(Arguments& o, bool& is_same) {
  const std::size_t threads =
      o.threads > 0 ? static_cast<std::size_t>(o.threads) : std::max(1U, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
  if (!o.size.empty()) {
    const auto size = tool::parse_size(o.size);
    if (!size) return tool::report_usage("--size takes WxH, sides 1 to 65536, not '" + o.size + "'");
    o.views.size = *size;
  }
  o.views.threads = o.threads;
  tool::InputFiles inputs;
  inputs.add_scene(o.a);
  inputs.add_scene(o.b);
  inputs.add_cameras(o.views.cameras);
  const bool prints_text = !o.quiet && o.json != "-";
  if (const int code = check_outputs(o, inputs, prints_text); code != tool::kSuccess) return code;
  audit::Sides sides;
  auto diff = audit::compare_files(o.a, o.b, o.read, o.tolerance, sides);
  // A change of a file explains any other error.
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!diff) return tool::report(diff.error().subject, diff.error().error);
  if (!o.pictures.empty()) {
    auto views = audit::draw_differences(o.pictures, sides, o.views, o.overwrite);
    if (!views) return tool::report(views.error().subject, views.error().error);
    diff->views = *std::move(views);
  }
  if (!o.ply.empty())
    if (const auto ok = audit::write_fates(o.ply, *diff, sides, o.overwrite); !ok)
      return tool::report(o.ply, ok.error());
  if (!o.json.empty())
    if (const auto ok = audit::write_text(o.json, audit::diff_json(*diff), o.overwrite); !ok)
      return tool::report(o.json, ok.error());
  if (prints_text) tool::print(audit::diff_text(*diff));
  is_same = diff->same();
  return tool::kSuccess;
}

void add_options(CLI::App& app, Arguments& o) {
  app.add_option("a", o.a, "a scene, " + rgs::format_list() + "; its content decides")->required();
  app.add_option("b", o.b, "the scene to compare with it, in any of these formats")->required();
  app.add_option("--tolerance", o.tolerance, "means that differ by no more are equal, in world units")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--json", o.json, "write the differences as JSON (docs/user/DIFF_JSON.md); - for standard output")
      ->option_text("FILE");
  app.add_option(
         "--ply", o.ply,
         "write B and what A alone has as a PLY: unchanged grey, moved blue, reshaped yellow, recoloured green, "
         "other opacity magenta, added cyan, removed red")
      ->option_text("FILE");
  auto* const cameras = app.add_option("--cameras", o.views.cameras, "camera file or COLMAP folder, for --pictures");
  auto* const pictures =
      app.add_option("--pictures", o.pictures, "draw both files by the cameras, and their difference")
          ->option_text("FOLDER")
          ->needs(cameras);
  cameras->needs(pictures);
  app.add_option("--split", o.views.split, "cameras: train, test or all")
      ->check(CLI::IsMember({"train", "test", "all"}))
      ->needs(pictures);
  app.add_option("--size", o.size, "WxH pixels of the pictures [the cameras' own]")->needs(pictures);
  app.add_option("--threads", o.threads, "CPU threads, 0 for all cores; no result depends on it")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  tool::add_max_expansion(app, o.read.limits);
  tool::add_spz_axes(app, o.read.spz_axes);
  app.add_flag("--overwrite", o.overwrite, "replace existing outputs");
  app.add_flag("--quiet,-q", o.quiet, "print nothing: the exit code is the answer");
  app.set_version_flag("--version", "rgs-diff " RGS_VERSION);
  app.footer(
      "rgs-audit A B --cameras FILE rates pictures.\n"
      "Exit codes: 0 same, 1 different, 2 usage, 3 input/output, 4 malformed input, 7 internal error.");
}

}  // namespace

int main(int argc, char** argv) {
  bool is_same = true;
  const int code = tool::run([&]() -> int {
    Arguments arguments;
    CLI::App app{"Says what differs between two splat files: Gaussians that moved, changed, are gone or new.",
                 "rgs-diff"};
    add_options(app, arguments);
    if (const auto ended = tool::parse(app, argc, argv)) return *ended;
    return compare(arguments, is_same);
  });
  if (code == tool::kInternal) return kBug;
  return code == tool::kSuccess && !is_same ? kDifferent : code;
}
