// rgs_convert.cpp - rgs-convert: 3DGS PLY to .rgs and back. Arguments and exit codes; the work is in src/convert_*.cpp.
// SPDX-License-Identifier: Apache-2.0
#include <tbb/global_control.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <thread>

#include "console.hpp"
#include "convert.hpp"
#include "convert_summary.hpp"
#include "rgs/camera_file.hpp"
#include "sibling_program.hpp"
#include "spool_file.hpp"

namespace {

namespace tool = rgs::tool;

enum class Format { automatic, ply, rgs };

struct Arguments {
  std::string input, output, cameras, axes = "3dgs";
  Format from = Format::automatic, to = Format::automatic;
  rgs::ConvertOptions convert;
  bool keep_order = false, explicit_policy = false, no_sync = false, json = false, quiet = false;
  bool file_scales = false, audit = false;
  int threads = 0;
  const char* rgs_option = nullptr;  // one that was given, see kRgsOptions
};

// What shapes an .rgs file. With a .ply output they are refused: leaving them without effect would mislead.
constexpr const char* kRgsOptions[] = {"--profile",    "--level",       "--keep-order",   "--keep-permutation",
                                       "--chunk-size", "--file-scales", "--sh-degree",    "--on-bad",
                                       "--cameras",    "--near",        "--far",          "--depth-map",
                                       "--axes",       "--aa-mode",     "--colour-space", "--metres-per-unit",
                                       "--audit"};

// "right,down,forward" or a name for a usual frame.
rgs::Result<std::array<rgs::Axis, 3>> parse_axes(const std::string& text) {
  using rgs::Axis;
  static const std::map<std::string, std::array<Axis, 3>> kFrames = {
      {"3dgs", {Axis::right, Axis::down, Axis::forward}},
      {"gltf", {Axis::right, Axis::up, Axis::backward}},
      {"undeclared", {Axis::undeclared, Axis::undeclared, Axis::undeclared}}};
  static const std::map<std::string, Axis> kDirections = {{"right", Axis::right},     {"left", Axis::left},
                                                          {"up", Axis::up},           {"down", Axis::down},
                                                          {"forward", Axis::forward}, {"backward", Axis::backward}};
  if (const auto frame = kFrames.find(text); frame != kFrames.end()) return frame->second;
  std::array<Axis, 3> axes{};
  std::size_t start = 0;
  unsigned spanned = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const std::size_t comma = i < 2 ? text.find(',', start) : text.size();
    const auto direction =
        comma == std::string::npos ? kDirections.end() : kDirections.find(text.substr(start, comma - start));
    if (direction == kDirections.end()) break;
    axes[i] = direction->second;
    spanned |= 1u << ((static_cast<unsigned>(axes[i]) - 1) / 2);
    start = comma + 1;
  }
  if (spanned == 7) return axes;
  return rgs::fail(rgs::Errc::bad_argument, rgs::Error::kNone,
                   "--axes takes 3dgs, gltf, undeclared or three directions that span space, e.g. right,down,forward");
}

Format format_of_name(const std::string& path) {
  const std::string extension = std::filesystem::path(path).extension().string();
  if (extension == ".rgs") return Format::rgs;
  if (extension == ".ply") return Format::ply;
  return Format::automatic;
}

Format format_of_bytes(std::span<const std::byte> bytes) {
  if (bytes.size() >= rgs::kMagic.size() && std::memcmp(bytes.data(), rgs::kMagic.data(), rgs::kMagic.size()) == 0) {
    return Format::rgs;
  }
  return Format::ply;
}

rgs::StageObserver observe(tool::Progress& progress) {
  rgs::StageObserver observer;
  observer.begin = [&progress](const char* stage, std::uint64_t total, const char* unit) {
    progress.begin(stage, total, unit);
  };
  observer.advance = [&progress](std::uint64_t units) { progress.advance(units); };
  observer.finish = [&progress] { progress.finish(); };
  return observer;
}

// Failures that are the output's and not the input's.
bool concerns_output(rgs::Errc code) {
  using rgs::Errc;
  return code == Errc::write_failed || code == Errc::output_exists || code == Errc::output_unusable;
}

// The input's bytes: a mapped file, or standard input spooled.
class Input {
 public:
  rgs::Status open(const std::string& path) {
    if (path != "-") {
      auto file = rgs::MappedFile::open(path);
      if (!file) return tl::unexpected(file.error());
      file_ = std::move(*file);
      bytes_ = file_.bytes();
      return {};
    }
    std::vector<std::byte> buffer(std::size_t{1} << 20);
    for (;;) {
      const ssize_t n = ::read(STDIN_FILENO, buffer.data(), buffer.size());
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) {
        return rgs::fail(rgs::Errc::read_failed, rgs::Error::kNone, "cannot read standard input", rgs::Error::kNone,
                         rgs::Error::kNone, errno);
      }
      if (n == 0) break;
      if (rgs::Status s = spool_.append(std::span(buffer).first(static_cast<std::size_t>(n))); !s) return s;
    }
    if (rgs::Status s = spool_.finish(); !s) return s;
    bytes_ = spool_.bytes();
    return {};
  }
  std::span<const std::byte> bytes() const { return bytes_; }

 private:
  rgs::MappedFile file_;
  rgs::detail::SpoolFile spool_;
  std::span<const std::byte> bytes_;
};

rgs::Result<rgs::ConvertSummary> convert(const Arguments& arguments, std::span<const std::byte> bytes, Format from,
                                         const rgs::StageObserver& observer) {
  if (from == Format::rgs) {
    const auto view = rgs::open(bytes);
    if (!view) return tl::unexpected(view.error());
    return rgs::convert_rgs_to_ply(*view, arguments.output, arguments.convert.output, observer);
  }
  const auto ply = rgs::PlyFile::open(bytes);
  if (!ply) return tl::unexpected(ply.error());
  return rgs::convert_ply_to_rgs(*ply, arguments.output, arguments.convert, observer);
}

// Where rgs-audit writes its report: "scene.rgs" gives "scene.audit.html".
std::string report_path(const std::string& output) {
  return std::filesystem::path(output).replace_extension(".audit.html").string();
}

// The audit needs both as files, and its program before an hour of work rather than after it.
int check_audit(const Arguments& arguments, std::string& program) {
  if (!arguments.audit) return tool::kSuccess;
  if (arguments.input == "-" || arguments.output == "-")
    return tool::report_usage("--audit compares two files; name input and output instead of -");
  const auto found = tool::sibling_program("rgs-audit");
  if (!found) return tool::report("rgs-audit", found.error());
  program = *found;
  std::error_code ignored;
  if (!arguments.convert.output.overwrite && std::filesystem::exists(report_path(arguments.output), ignored))
    return tool::report(report_path(arguments.output), {rgs::Errc::output_exists, rgs::Error::kNone,
                                                        "the report exists already; pass --overwrite to replace it"});
  return tool::kSuccess;
}

// Another program, because pictures need libraries that a converter should not.
int run_audit(const Arguments& arguments, const std::string& program) {
  std::vector<std::string> options{arguments.input, arguments.output, "--report", report_path(arguments.output)};
  if (!arguments.cameras.empty()) options.insert(options.end(), {"--cameras", arguments.cameras});
  if (arguments.convert.output.overwrite) options.emplace_back("--overwrite");
  if (arguments.threads > 0) options.insert(options.end(), {"--threads", std::to_string(arguments.threads)});
  if (arguments.quiet || arguments.json) options.emplace_back("--quiet");
  const auto code = tool::run_program_and_wait(program, options);
  return code ? *code : tool::report(program, code.error());
}

int convert_main(Arguments& arguments) {
  rgs::remove_temporaries_on_signal();
  if (const auto axes = parse_axes(arguments.axes)) {
    arguments.convert.encode.axes = *axes;
  } else {
    return tool::report("", axes.error());
  }
  rgs::EncodeOptions& encode = arguments.convert.encode;
  encode.order = arguments.keep_order ? rgs::Order::input : rgs::Order::morton;
  encode.chunk_scales = !arguments.file_scales;
  if (arguments.explicit_policy) encode.max_bad_fraction = 1;
  arguments.convert.output.sync = !arguments.no_sync;
  const std::size_t threads = arguments.threads > 0 ? static_cast<std::size_t>(arguments.threads)
                                                    : std::max(1u, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);

  if (arguments.json && arguments.output == "-")
    return tool::report_usage("--json and output - both need standard output");
  if (arguments.input != "-" && arguments.output != "-" && rgs::same_file(arguments.input, arguments.output)) {
    return tool::report(arguments.output,
                        {rgs::Errc::output_unusable, rgs::Error::kNone, "input and output are the same file"});
  }
  std::string auditor;
  if (const int code = check_audit(arguments, auditor); code != tool::kSuccess) return code;
  Input input;
  if (const rgs::Status s = input.open(arguments.input); !s) return tool::report(arguments.input, s.error());
  const Format from = arguments.from != Format::automatic ? arguments.from : format_of_bytes(input.bytes());
  const Format to = arguments.to != Format::automatic ? arguments.to : format_of_name(arguments.output);
  if (to == Format::automatic)
    return tool::report_usage("cannot tell the output's format from its name: pass --to rgs or --to ply");
  if (from == to)
    return tool::report_usage("input and output have the same format; this program converts between .ply and .rgs");
  if (to == Format::ply && arguments.rgs_option != nullptr)
    return tool::report_usage(std::string(arguments.rgs_option) + " is for .rgs outputs");
  if (!arguments.cameras.empty()) {
    auto cameras = rgs::read_cameras(arguments.cameras);
    if (!cameras) return tool::report(arguments.cameras, cameras.error());
    arguments.convert.cameras = std::move(*cameras);
  }
  std::string name = arguments.input == "-" ? "stdin" : std::filesystem::path(arguments.input).filename().string();
  name.resize(std::min<std::size_t>(name.size(), rgs::kMaxProvenanceText));
  encode.provenance = rgs::Provenance{input.bytes().size(), 0, name, "rgs-convert " RGS_VERSION};

  rgs::Result<rgs::ConvertSummary> summary;
  {
    tool::Progress progress(arguments.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    summary = convert(arguments, input.bytes(), from, observe(progress));
  }
  if (!summary) {
    return tool::report(concerns_output(summary.error().code) ? arguments.output : arguments.input, summary.error());
  }
  summary->source_name = name;
  if (arguments.json) {
    std::fputs(rgs::summary_json(*summary).c_str(), stdout);
  } else if (!arguments.quiet) {
    std::fputs(rgs::summary_text(*summary).c_str(), arguments.output == "-" ? stderr : stdout);
  }
  if (std::fflush(stdout) != 0) {
    return tool::report("standard output", {rgs::Errc::write_failed, rgs::Error::kNone, "cannot write the summary",
                                            rgs::Error::kNone, rgs::Error::kNone, errno});
  }
  return arguments.audit ? run_audit(arguments, auditor) : tool::kSuccess;
}

void add_options(CLI::App& app, Arguments& a) {
  rgs::EncodeOptions& e = a.convert.encode;
  const std::map<std::string, Format> formats{{"ply", Format::ply}, {"rgs", Format::rgs}};
  const std::map<std::string, rgs::Profile> profiles{{"direct", rgs::Profile::direct},
                                                     {"packed", rgs::Profile::packed}};
  const std::map<std::string, rgs::BadPolicy> policies{
      {"refuse", rgs::BadPolicy::refuse}, {"drop", rgs::BadPolicy::drop}, {"repair", rgs::BadPolicy::repair}};
  const std::map<std::string, rgs::DepthMapping> mappings{{"linear", rgs::DepthMapping::linear},
                                                          {"log", rgs::DepthMapping::logarithmic}};
  const std::map<std::string, rgs::AaMode> aa_modes{{"undeclared", rgs::AaMode::undeclared},
                                                    {"classic", rgs::AaMode::classic},
                                                    {"mip-splatting", rgs::AaMode::mip_splatting}};
  const std::map<std::string, rgs::ColourSpace> colour_spaces{{"undeclared", rgs::ColourSpace::undeclared},
                                                              {"srgb", rgs::ColourSpace::srgb_display},
                                                              {"linear", rgs::ColourSpace::linear_display}};
  app.add_option("input", a.input, "3DGS .ply or .rgs file; - for standard input")->required();
  app.add_option("output", a.output, "The other of the two; - for standard output (then pass --to)")->required();
  app.add_option("--from", a.from, "Format of the input; default: by its content")
      ->transform(CLI::Transformer(formats))
      ->option_text("ply|rgs");
  app.add_option("--to", a.to, "Format of the output; default: by its name")
      ->transform(CLI::Transformer(formats))
      ->option_text("ply|rgs");
  e.profile = rgs::Profile::packed;
  app.add_option("--profile", e.profile, "packed (the default), or direct: as the GPU reads it; same Gaussians")
      ->transform(CLI::Transformer(profiles))
      ->option_text("packed|direct");
  app.add_option("--level", e.level, "Effort of packed, 1 to 19 [1]: above 1 slower to write and a little smaller")
      ->check(CLI::Range(1, rgs::kMaxLevel));
  app.add_flag("--keep-order", a.keep_order, "Keep the order of the input instead of a Morton curve");
  app.add_flag("--keep-permutation", e.keep_permutation, "Store each Gaussian's position in the input (4 bytes)");
  app.add_option("--chunk-size", e.chunk_size, "Gaussians per chunk, a multiple of 32 from 32 to 65536 [256]");
  app.add_flag("--file-scales", a.file_scales, "One set of SH scales for the file instead of one per chunk");
  app.add_option("--sh-degree", e.sh_degree, "Strip SH above this degree")->check(CLI::Range(0, 3));
  app.add_option("--on-bad", e.on_bad, "Damaged Gaussians; by default they are dropped if at most 1 % are damaged")
      ->transform(CLI::Transformer(policies))
      ->option_text("refuse|drop|repair")
      ->each([&a](const std::string&) { a.explicit_policy = true; });
  app.add_option("--cameras", a.cameras,
                 "Depth range of the sort key as these cameras see the scene (docs/CAMERAS.md)");
  app.add_option("--near", a.convert.z_near, "Near end of the depth range, world units")->check(CLI::PositiveNumber);
  app.add_option("--far", a.convert.z_far, "Far end of the depth range, world units")->check(CLI::PositiveNumber);
  app.add_option("--depth-map", e.depth_mapping, "Mapping of depth to the sort key [log]")
      ->transform(CLI::Transformer(mappings))
      ->option_text("linear|log");
  app.add_option("--axes", a.axes,
                 "Where +x,+y,+z point: 3dgs (right,down,forward), gltf, undeclared, or three directions");
  app.add_option("--aa-mode", e.aa_mode, "Anti-aliasing that the scene was trained with")
      ->transform(CLI::Transformer(aa_modes))
      ->option_text("classic|mip-splatting|undeclared");
  app.add_option("--colour-space", e.colour_space, "Colours that SH evaluates to")
      ->transform(CLI::Transformer(colour_spaces))
      ->option_text("srgb|linear|undeclared");
  app.add_option("--metres-per-unit", e.metres_per_unit, "Size of a world unit, if known")
      ->check(CLI::NonNegativeNumber);
  app.add_flag("--audit", a.audit, "Then run rgs-audit on it and write OUTPUT.audit.html; its exit code is passed on");
  app.add_flag("--overwrite", a.convert.output.overwrite, "Replace an existing output");
  app.add_flag("--no-sync", a.no_sync, "Do not wait until the output is on disk");
  app.add_option("--threads", a.threads, "Threads; default: all")->check(CLI::Range(1, 1024));
  app.add_flag("--json", a.json, "Summary as JSON on standard output (docs/CONVERT_JSON.md)");
  app.add_flag("--quiet", a.quiet, "No progress, no summary");
  for (const char* name : kRgsOptions) app.get_option(name)->group("Options for .rgs output");
}

int parse_and_convert(int argc, char** argv) {
  CLI::App app("Converts trained 3D Gaussian splat scenes between PLY and .rgs.", "rgs-convert");
  app.set_version_flag("--version", "rgs-convert " RGS_VERSION);
  Arguments arguments;
  add_options(app, arguments);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? tool::kSuccess : tool::kUsage;
  }
  for (const char* name : kRgsOptions) {
    if (app.get_option(name)->count() != 0) arguments.rgs_option = name;
  }
  return convert_main(arguments);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&] { return parse_and_convert(argc, argv); });
}
