// audit.cpp - rgs-convert --audit.
// SPDX-License-Identifier: Apache-2.0
#include <filesystem>

#include "rgs_convert.hpp"
#include "sibling_program.hpp"

namespace rgs {

void add_audit(CLI::App& app, bool& audit) {
  app.option_defaults()->group(kRgsGroup);
  app.add_flag("--audit", audit, "Then run rgs-audit, write OUTPUT.audit.html and return its exit code");
}

std::string audit_report(const std::string& output) {
  return std::filesystem::path(output).replace_extension(".audit.html").string();
}

int check_audit(const ConvertArguments& arguments, std::string& program) {
  if (!arguments.audit) return tool::kSuccess;
  const SceneOptions& scene = arguments.scene;
  if (scene.files.front() == "-" || scene.output() == "-")
    return tool::report_usage("--audit compares two files; name files instead of -");
  if (scene.n_inputs() > 1 || scene.level_of_detail)
    return tool::report_usage("--audit compares an .rgs with all Gaussians of one source file");
  if (scene.moves())
    return tool::report_usage(
        "--audit requires Gaussians to stay where the source has them; drop the options that move them");
  const auto found = tool::sibling_program("rgs-audit");
  if (!found) return tool::report("rgs-audit", found.error());
  program = *found;
  std::error_code ignored;
  const std::string report = audit_report(scene.output());
  if (!arguments.output.convert.output.overwrite && std::filesystem::exists(report, ignored))
    return tool::report(report,
                        {Errc::output_exists, Error::kNone, "the report exists; pass --overwrite to replace it"});
  return tool::kSuccess;
}

int run_audit(const ConvertArguments& arguments, const std::string& program) {
  tool::flush();  // before the other program prints
  const SceneOptions& scene = arguments.scene;
  const RunOptions& run = arguments.run;
  std::vector<std::string> options{scene.files.front(), scene.output(), "--report", audit_report(scene.output())};
  if (!arguments.output.cameras.empty()) options.insert(options.end(), {"--cameras", arguments.output.cameras});
  if (scene.spz_axes == kAxesOpenGl) options.insert(options.end(), {"--spz-axes", "opengl"});
  if (arguments.output.convert.output.overwrite) options.emplace_back("--overwrite");
  if (run.threads > 0) options.insert(options.end(), {"--threads", std::to_string(run.threads)});
  if (run.quiet || run.json) options.emplace_back("--quiet");
  const auto code = tool::run_program_and_wait(program, options);
  return code ? *code : tool::report(program, code.error());
}

}  // namespace rgs
