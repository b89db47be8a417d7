// rgs_convert.cpp - rgs-convert: splat files of any format to any other. Chooses the mode.
// SPDX-License-Identifier: Apache-2.0
#include "rgs_convert.hpp"

#include <filesystem>

#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"

namespace {

namespace tool = rgs::tool;

bool affects_output(const CLI::Option& option) {
  const std::string& group = option.get_group();
  return group == rgs::kSceneGroup ? !option.get_positional()
                                   : group == rgs::kRgsGroup && option.get_name() != "--cameras";  // its contents do
}

// Keeps what was given for an .rgs, and all that affects an output, sorted so that the order does not matter.
void note_options(const CLI::App& app, rgs::ConvertArguments& arguments) {
  std::map<std::string, std::string> given;
  for (const CLI::Option* option : app.get_options()) {
    if (option->count() == 0) continue;
    if (option->get_group() == rgs::kRgsGroup || option->get_group() == rgs::kLevelsGroup)
      arguments.output.rgs_option = option->get_name();
    if (!affects_output(*option)) continue;
    std::string& values = given[option->get_name()];
    for (const std::string& value : option->results()) values += " '" + value + "'";
  }
  for (const auto& [name, values] : given) arguments.given += name + values + "\n";
}

int parse_and_convert(int argc, char** argv) {
  CLI::App app("Converts trained 3D Gaussian splat scenes between .rgs and other formats.", "rgs-convert");
  app.set_version_flag("--version", "rgs-convert " RGS_VERSION);
  app.footer(
      "Writes " + rgs::format_list(true) +
      " (--formats says what each keeps).\n"
      "Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input, 6 a file with levels of detail "
      "is cut off and lacks what was asked for; with --target-psnr and --target-size also 5, out of reach; with "
      "--audit also those of rgs-audit. Many scenes return the worst, in this order: 1, 3, 2, 4, 6.");
  rgs::ConvertArguments arguments;
  rgs::ManyScenes many;
  rgs::SceneInParts parts;
  arguments.scene.add_to(app);
  arguments.output.add_to(app);
  rgs::add_audit(app, arguments.audit);
  arguments.run.add_to(app);
  many.add_to(app);
  parts.add_to(app);
  bool lists_formats = false;
  app.option_defaults()->group(rgs::kRunGroup);
  app.add_flag("--formats", lists_formats, "List the formats and what each keeps, in Markdown");
  if (const auto code = tool::parse(app, argc, argv)) return *code;
  if (lists_formats) return tool::print(rgs::format_table()), tool::kSuccess;
  note_options(app, arguments);
  if (!parts.step.empty()) return parts.convert(app, arguments, many.list);
  for (const char* name : {"--lod-input", "--ranges"}) {
    if (const CLI::Option* option = app.get_option_no_throw(name); option != nullptr && option->count() != 0)
      return tool::report_usage(std::string(name) + " requires --lod-partition or --lod-build");
  }
  const std::vector<std::string>& files = arguments.scene.files;
  if (files.empty()) return tool::report_usage("files are required: rgs-convert INPUT OUTPUT");
  std::error_code ignored;
  if (!many.list.empty() || std::filesystem::is_directory(rgs::detail::path_of(files.front()), ignored))
    return many.convert(arguments);
  if (files.size() < 2) return tool::report_usage("an input needs an output: rgs-convert INPUT OUTPUT");
  for (const CLI::Option* option : app.get_options()) {
    if (option->count() != 0 && option->get_group() == rgs::kBatchGroup)
      return tool::report_usage(option->get_name() + " requires a folder of scenes or --list");
  }
  return rgs::convert_one_scene(arguments);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&] { return parse_and_convert(argc, argv); });
}
