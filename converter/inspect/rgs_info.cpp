// rgs_info.cpp - prints and checks .rgs files.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <charconv>
#include <string>
#include <string_view>

#include "command_line.hpp"
#include "console.hpp"
#include "info_json.hpp"
#include "info_report.hpp"
#include "info_text.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "rgs/file.hpp"
#include "rgs/version.hpp"
#include "system.hpp"

namespace {

using namespace rgs;
using namespace rgs::tool;

struct Arguments {
  std::string path;
  InfoOptions options;
  bool json = false, ascii = false;
};

// "10%" or "10": 0.1. Above 0, at most 1.
Result<double> parse_percentage(std::string_view text) {
  if (text.ends_with('%')) text.remove_suffix(1);
  double percent = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), percent);
  if (error == std::errc() && end == text.data() + text.size() && percent > 0 && percent <= 100) return percent / 100;
  return make_error(Errc::bad_argument, Error::kNone, "not a percentage above 0, up to 100, such as 10%");
}

int info(const Arguments& arguments) {
  InfoReport report;
  InputFiles inputs;
  inputs.add(arguments.path);
  if (const int code = inputs.check_outputs(std::array<std::string, 1>{"-"}); code != kSuccess) return code;
  const auto file = MappedFile::open(arguments.path);
  failpoint("read");
  if (file) {
    report = inspect(arguments.path, file->bytes(), arguments.options);
  } else {
    report.path = arguments.path;
    report.error = file.error();
  }
  if (inputs.changed()) {  // if the file changes meanwhile, an error found in it describes no file
    report = {};
    report.path = arguments.path;
    report.error = kFileChanged;
  }
  print_to_pipe(arguments.json ? info_json(report) : info_text(report, arguments.ascii));
  return report.error ? rgs::tool::report(arguments.path, *report.error) : kSuccess;
}

int body(int argc, char** argv) {
  Arguments arguments;
  bool stats = false, no_stats = false;
  std::string chunk, page, levels;
  CLI::App app("Prints what an .rgs file holds and declares, and checks it.", "rgs-info");
  app.set_version_flag("--version", "rgs-info " RGS_VERSION);
  app.add_option("FILE", arguments.path, "an .rgs file; rgs-convert makes one of other formats")->required();
  auto* verify_flag = app.add_flag("--verify", arguments.options.verify, "check every checksum and every stored value");
  app.add_option(
         "--levels", levels,
         "with --verify: also compare N percent of the pages above the leaves, at least one, with their children")
      ->type_name("N%")
      ->needs(verify_flag);
  app.add_flag("--json", arguments.json, "one JSON document (schema rgs-info/1, docs/user/INFO_JSON.md)");
  app.add_option("--chunk", chunk, "report chunk N (from 0) instead of the file")->type_name("N");
  app.add_option("--page", page, "report page N (from 0) of a file with levels of detail instead of the file")
      ->type_name("N")
      ->excludes("--chunk");
  auto* stats_flag = app.add_flag("--stats", stats, "read all values for ranges and histograms (default up to 1 GB)");
  app.add_flag("--no-stats", no_stats, "read header and tables only")->excludes(stats_flag);
  add_max_expansion(app, arguments.options.limits);
  app.add_flag("--ascii", arguments.ascii, "print ASCII characters only");
  app.footer(
      "Exit codes: 0 fine, 1 internal, 2 usage, 3 input/output, 4 malformed or damaged file or false errors of pages, "
      "6 the end of a "
      "file with levels of detail is missing (the rest is the whole scene, in less detail).");
  if (const auto code = parse(app, argc, argv)) return *code;
  if (stats || no_stats) arguments.options.statistics = stats;
  const auto read_index = [](const char* option, const std::string& text, std::optional<std::uint64_t>& index) {
    if (text.empty()) return kSuccess;
    const auto count = parse_count(text);
    if (!count) return static_cast<ExitCode>(report_usage(option + (": " + describe(count.error()))));
    index = *count;
    return kSuccess;
  };
  if (const int code = read_index("--chunk", chunk, arguments.options.chunk); code != kSuccess) return code;
  if (const int code = read_index("--page", page, arguments.options.page); code != kSuccess) return code;
  if (!levels.empty()) {
    const auto share = parse_percentage(levels);
    if (!share) return report_usage("--levels: " + describe(share.error()));
    arguments.options.levels_share = *share;
  }
  return info(arguments);
}

}  // namespace

int main(int argc, char** argv) {
  ignore_closed_pipes();
  return run([&] { return body(argc, argv); });
}
