// audit.cpp - rgs-convert --audit.
// SPDX-License-Identifier: Apache-2.0
#include <filesystem>

#include "rgs/utf8_path.hpp"
#include "rgs_convert.hpp"
#include "sibling_program.hpp"

namespace rgs {

void add_audit(CLI::App& app, bool& audit) {
  app.option_defaults()->group(kRgsGroup);
  app.add_flag("--audit", audit, "Then run rgs-audit, write OUTPUT.audit.html and return its exit code");
}

std::string audit_report(const std::string& output) {
  return detail::path_of(output).replace_extension(".audit.html").string();
}

int find_auditor(const ConvertArguments& arguments, const std::string& option, std::string& program) {
  const SceneOptions& scene = arguments.scene;
  if (scene.files.front() == "-" || scene.output() == "-")
    return tool::report_usage(option + " compares two files; name files instead of -");
  if (scene.n_inputs() > 1 || scene.level_of_detail)
    return tool::report_usage(option + " compares an .rgs with all Gaussians of one source file");
  if (scene.moves())
    return tool::report_usage(option +
                              " requires Gaussians to stay where the source has them; drop the options that move them");
  const auto found = tool::sibling_program("rgs-audit");
  if (!found) return tool::report("rgs-audit", found.error());
  program = *found;
  return tool::kSuccess;
}

int check_audit(const ConvertArguments& arguments, std::string& program) {
  if (!arguments.audit) return tool::kSuccess;
  if (const int code = find_auditor(arguments, "--audit", program); code != tool::kSuccess) return code;
  std::error_code ignored;
  const std::string report = audit_report(arguments.scene.output());
  if (!arguments.output.convert.output.overwrite && std::filesystem::exists(detail::path_of(report), ignored))
    return tool::report(report,
                        {Errc::output_exists, Error::kNone, "the report exists; pass --overwrite to replace it"});
  return tool::kSuccess;
}

std::vector<std::string> audit_options(const ConvertArguments& arguments, const std::string& asset) {
  const SceneOptions& scene = arguments.scene;
  const RunOptions& run = arguments.run;
  std::vector<std::string> options{scene.files.front(), asset};
  if (!arguments.output.cameras.empty()) options.insert(options.end(), {"--cameras", arguments.output.cameras});
  if (scene.spz_axes == kAxesOpenGl) options.insert(options.end(), {"--spz-axes", "opengl"});
  if (run.threads > 0) options.insert(options.end(), {"--threads", std::to_string(run.threads)});
  if (run.quiet || run.json) options.emplace_back("--quiet");
  return options;
}

int run_audit(const ConvertArguments& arguments, const std::string& program) {
  tool::flush();  // before the other program prints
  const std::string& output = arguments.scene.output();
  auto options = audit_options(arguments, output);
  options.insert(options.end(), {"--report", audit_report(output)});
  if (arguments.output.convert.output.overwrite) options.emplace_back("--overwrite");
  const auto code = tool::run_program_and_wait(program, options);
  return code ? *code : tool::report(program, code.error());
}

}  // namespace rgs
