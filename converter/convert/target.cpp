// target.cpp - rgs-convert --target-psnr and --target-size: archives of other steps until one is as asked.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <limits>
#include <nlohmann/json.hpp>
#include <utility>

#include "rgs/ply.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs_convert.hpp"
#include "sibling_program.hpp"

namespace rgs {
namespace {

// A descriptor that is closed at the end.
struct Descriptor {
  const int fd;
  ~Descriptor() {
    if (fd >= 0) ::close(fd);
  }
};

// Of inputs that state it first; else 0.
std::uint64_t count_gaussians(const SceneOptions& scene, const std::deque<SceneInput>& inputs) {
  std::uint64_t n = 0;
  for (const SceneInput& input : inputs) {
    const auto ply = PlyFile::open(input.bytes());
    if (scene.format_of(input) != SplatFormat::ply || !ply) return 0;
    n += ply->size();
  }
  return n;
}

// Of the views of rgs-audit; else an exit code, when the error is reported.
tl::expected<double, int> measure_psnr(const ConvertArguments& arguments, const std::string& auditor, int asset) {
  const std::string& output = arguments.scene.output();
  const std::string folder = detail::path_of(output).parent_path().string();
  const Descriptor json{detail::open_scratch(folder.empty() ? "." : folder)};
  const tool::NameForPrograms name(asset);
  if (json.fd < 0 || name.path().empty())
    return tl::unexpected(tool::report(output, {Errc::write_failed, Error::kNone, "cannot create a temporary file",
                                                Error::kNone, Error::kNone, errno}));
  auto options = audit_options(arguments, name.path());
  options.insert(options.end(), {"--json", "-", "--no-attribution", "--no-distances"});
  const auto code = tool::run_program_and_wait(auditor, options, json.fd);
  if (!code) return tl::unexpected(tool::report(auditor, code.error()));
  if (*code != tool::kSuccess) return tl::unexpected(*code);
  const auto text = MappedFile::map(json.fd);
  if (!text) return tl::unexpected(tool::report(auditor, text.error()));
  const auto* const first = reinterpret_cast<const char*>(text->bytes().data());
  const auto result = nlohmann::json::parse(first, first + text->bytes().size(), nullptr, false);
  const auto rated = nlohmann::json::json_pointer("/rendered/n_rated");
  if (!result.is_object() || !result.contains(rated))
    return tl::unexpected(
        tool::report(auditor, {Errc::internal, Error::kNone, "is of another version; install both into one folder"}));
  if (result[rated] == 0)
    return tl::unexpected(tool::report(
        output, {Errc::gate_failed, Error::kNone, "no view shows the scene; pass --cameras that look at it"}));
  const auto& psnr = result["rendered"]["psnr"];  // null: identical pictures
  return psnr.is_number() ? psnr.get<double>() : std::numeric_limits<double>::infinity();
}

int report_missed(const ConvertArguments& arguments, std::span<const ArchivePass> passes) {
  const ArchiveTarget& target = arguments.output.target;
  const auto best = std::ranges::max_element(
      passes, {}, [&](const ArchivePass& p) { return target.psnr ? *p.psnr : -static_cast<double>(p.bytes); });
  const std::string reached =
      target.psnr ? fmt::format(
                        "--target-psnr {}: step {:.4g} reached {:.2f} dB with {} bytes, the best of {} tried; ask "
                        "for less, or choose --profile packed",
                        *target.psnr, best->step, *best->psnr, best->bytes, passes.size())
                  : fmt::format(
                        "--target-size {}: step {:.4g} reached {} bytes, the least of {} tried; allow more, or "
                        "write less: --sh-degree, rgs-prune",
                        *target.bytes, best->step, best->bytes, passes.size());
  return tool::report(arguments.scene.output(), {Errc::gate_failed, Error::kNone, reached.c_str()});
}

}  // namespace

int check_target(const ConvertArguments& arguments, std::string& auditor) {
  const ArchiveTarget& target = arguments.output.target;
  if (target.option() == nullptr) return tool::kSuccess;
  if (std::ranges::count(arguments.scene.files, "-") != 0)
    return tool::report_usage(std::string(target.option()) +
                              " makes several files to choose from; name files instead of -");
  return target.psnr ? find_auditor(arguments, target.option(), auditor) : tool::kSuccess;
}

tl::expected<ConvertSummary, int> convert_to_target(ConvertArguments arguments, const std::deque<SceneInput>& inputs,
                                                    const std::string& auditor) {
  const ArchiveTarget& target = arguments.output.target;
  AtomicFile pass, kept;
  arguments.output.convert.output.hold = &pass;
  const std::uint64_t n = count_gaussians(arguments.scene, inputs);
  ArchiveSearch search{target, {}, 0};
  ConvertSummary summary;
  while (const auto step = next_step(target, search.passes, n)) {
    arguments.output.convert.encode.archive.step = *step;
    auto made = convert_open(arguments, inputs, arguments.run.progress());
    // Finer steps may not hold a Gaussian that those of the kept file do.
    if (!made && made.error().error.code == Errc::bad_value && kept.descriptor() >= 0) break;
    if (!made) return tl::unexpected(report_failure(made.error()));
    search.passes.push_back({*step, made->output_bytes});
    if (target.psnr) {
      const auto psnr = measure_psnr(arguments, auditor, pass.descriptor());
      if (!psnr) return tl::unexpected(psnr.error());
      search.passes.back().psnr = *psnr;
    }
    AtomicFile latest = std::exchange(pass, AtomicFile());  // at most two files at a time
    if (kept_pass(target, search.passes) != &search.passes.back()) continue;
    search.kept = search.passes.size() - 1;
    kept = std::move(latest);
    summary = *std::move(made);
  }
  if (kept.descriptor() < 0) return tl::unexpected(report_missed(arguments, search.passes));
  const auto synced = kept.commit();
  if (!synced) return tl::unexpected(tool::report(arguments.scene.output(), synced.error()));
  summary.sync_seconds = *synced;
  summary.search = std::move(search);
  return summary;
}

}  // namespace rgs
