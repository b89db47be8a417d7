// rgs_prune.cpp - rgs-prune: keeps the Gaussians that contribute most to given pictures.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/global_control.h>

#include <array>
#include <chrono>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "camera_choice.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "convert.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "prune.hpp"
#include "rgs/checksum.hpp"
#include "rgs/renderer.hpp"
#include "rgs/splat_edit.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "scene_file.hpp"
#include "spz_axes.hpp"

namespace {

namespace fs = std::filesystem;
namespace tool = rgs::tool;
using Clock = std::chrono::steady_clock;
using rgs::Contribution;
using rgs::SplatFormat;

struct Options {
  rgs::ReadOptions read;
  std::string input, output, cameras, split, view = "all", size, keep_text, scores;
  rgs::prune::Score score = rgs::prune::Score::sum;
  rgs::prune::Keep keep;
  std::optional<double> min_contribution;
  rgs::RenderOptions render;
  int threads = 0;
  bool overwrite = false, no_sync = false, json = false, quiet = false;

  rgs::AtomicFile::Options file() const { return {.overwrite = overwrite, .sync = !no_sync}; }
};

// Or the exit code of a failure that is already reported.
template <class T>
using Step = tl::expected<T, int>;
tl::unexpected<int> failed(const std::string& file, const rgs::Error& error) {
  return tl::unexpected<int>(tool::report(file, error));
}

struct Summary {
  std::string format;
  std::uint64_t source_bytes = 0, n_source = 0, output_bytes = 0, pixels = 0;
  std::size_t n_cameras = 0;
  std::vector<std::string> lost;                          ///< declarations of the source that the output lacks
  std::uint64_t n_scale_subnormal = 0, n_scale_zero = 0;  // of an .rgs: below FP16's normal range; flushed to 0
  rgs::prune::Outcome outcome;
  double read_seconds = 0, render_seconds = 0, write_seconds = 0;
};

double lap(Clock::time_point& start) {
  const auto now = Clock::now();
  return std::chrono::duration<double>(now - std::exchange(start, now)).count();
}

// Fails early instead of after a minute of work. Returns an exit code.
int check_outputs(const Options& o, const tool::InputFiles& inputs, SplatFormat to) {
  if (to != SplatFormat::ply && to != SplatFormat::rgs)
    return tool::report_usage("the output must be a .ply or .rgs file; rgs-convert writes other formats");
  const std::array<std::string, 3> outputs{o.output, o.scores, o.json || !o.quiet ? "-" : ""};
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  for (const std::string& output : {o.output, o.scores}) {
    std::error_code ignored;
    if (!output.empty() && !o.overwrite && fs::exists(rgs::detail::path_of(output), ignored))
      return tool::report(
          output, {rgs::Errc::output_exists, rgs::Error::kNone, "the output exists; pass --overwrite to replace it"});
  }
  return tool::kSuccess;
}

// The scene in the frame that rgs-render uses: an .rgs in its own, all others in that of 3DGS.
Step<rgs::SplatFile> read_scene(const Options& o, std::uint64_t& hash) {
  const auto bytes = rgs::MappedFile::open(o.input);
  if (!bytes) return failed(o.input, bytes.error());
  tool::failpoint("read");
  hash = rgs::xxh3(bytes->bytes());
  rgs::ReadOptions as_stored = o.read;
  as_stored.keep_axes = true;
  auto file = rgs::read_splats(o.input, as_stored);
  if (!file) return failed(o.input, file.error());
  if (file->format != SplatFormat::rgs) {
    rgs::convert_axes(file->cloud, file->axes, rgs::kAxes3dgs);
    rgs::convert_axes(file->origin, file->axes, rgs::kAxes3dgs);
    rgs::convert_axes(file->crs, file->axes, rgs::kAxes3dgs);
    file->axes = rgs::kAxes3dgs;
  }
  return *std::move(file);
}

Step<std::vector<Contribution>> contributions_of(const Options& o, const rgs::SplatFile& file,
                                                 const std::vector<rgs::Camera>& cameras, tool::Progress& progress) {
  const auto scene = rgs::Scene::load(file.cloud, rgs::declarations_of(file));
  if (!scene) {
    rgs::Error error = scene.error();
    if (error.code == rgs::Errc::bad_value) std::swap(error.found, error.offset);  // an index, not a byte offset
    return failed(o.input, error);
  }
  auto renderer = rgs::Renderer::create({.backend = rgs::Backend::cpu, .threads = o.threads});
  if (!renderer) return failed("", renderer.error());
  std::vector<Contribution> contributions(scene->size());
  progress.begin("rendering", cameras.size(), "frames");
  for (const rgs::Camera& camera : cameras) {
    const auto rendered = renderer->render(*scene, camera, {.contributions = contributions}, o.render);
    if (!rendered) return failed(camera.name, rendered.error());
    progress.advance(1);
  }
  progress.finish();
  return contributions;
}

Step<void> write_scores(const Options& o, const std::vector<Contribution>& contributions) {
  auto file = rgs::AtomicFile::create(o.scores, o.file());
  if (!file) return failed(o.scores, file.error());
  if (const auto written = file->write_at(0, rgs::prune::scores_npy(contributions)); !written)
    return failed(o.scores, written.error());
  if (const auto done = file->commit(); !done) return failed(o.scores, done.error());
  return {};
}

Step<rgs::ConvertSummary> write_scene(const Options& o, SplatFormat to, rgs::SplatFile&& file,
                                      std::span<const std::uint64_t> kept, std::uint64_t n_source, std::uint64_t hash,
                                      std::vector<rgs::Camera> cameras) {
  // PLY implies the axes of 3DGS; an .rgs declares those of its source.
  if (to == SplatFormat::ply && file.axes[0] != rgs::Axis::undeclared) {
    rgs::convert_axes(file.cloud, file.axes, rgs::kAxes3dgs);
    rgs::convert_axes(file.origin, file.axes, rgs::kAxes3dgs);
    rgs::convert_axes(file.crs, file.axes, rgs::kAxes3dgs);
    file.axes = rgs::kAxes3dgs;
  }
  rgs::ConvertOptions options;
  options.encode = rgs::keep_declarations(std::move(options.encode), file);
  options.encode.profile = rgs::Profile::packed;
  options.encode.keep_permutation = !file.source_index.empty();  // if the .rgs kept it
  std::string name = rgs::detail::path_of(o.input).filename().string();
  name.resize(std::min<std::size_t>(name.size(), rgs::kMaxProvenanceText));
  options.encode.provenance = rgs::Provenance{file.bytes, hash, name, "rgs-prune " RGS_VERSION};
  if (!options.encode.depth) options.cameras = std::move(cameras);  // else the .rgs's declared range
  options.output = o.file();
  const double rest = rgs::largest_rest(file.cloud.mean_rest);
  if (to == SplatFormat::rgs && !rgs::check_rounding(rest, rgs::max_rounding(options.encode, false))) {
    return failed(o.output, {rgs::Errc::unsupported_feature, rgs::Error::kNone,
                             "FP32 rounds positions so far from the origin by more than a millimetre; write a PLY, and "
                             "rgs-convert --lod that",
                             rgs::Error::kNone, rgs::Error::kNone, 0});
  }
  const int degree = file.cloud.sh_degree;
  rgs::LoadedScene scene;
  scene.cloud = std::move(file.cloud);
  scene.format = rgs::format_name(file.format);
  scene.bytes = file.bytes;
  scene.xxh3 = hash;
  scene.n_source = n_source;
  scene.source_sh_degree = degree;
  scene.origin = file.origin;
  scene.unused = std::move(file.unused);
  rgs::keep_source(options.encode, scene, file, kept);
  auto written = rgs::convert_scene(std::move(scene), to, o.output, options);
  if (!written) return failed(o.output, written.error());
  return *std::move(written);
}

const char* score_name(rgs::prune::Score score) {
  return score == rgs::prune::Score::sum ? "sum" : "max";
}

std::string summary_json(const Options& o, const Summary& s) {
  const nlohmann::ordered_json json{
      {"program", "rgs-prune"},
      {"version", RGS_VERSION},
      {"source", {{"file", o.input}, {"format", s.format}, {"bytes", s.source_bytes}, {"gaussians", s.n_source}}},
      {"output", {{"file", o.output}, {"bytes", s.output_bytes}, {"gaussians", s.outcome.n_kept}}},
      {"score", score_name(o.score)},
      {"cameras", s.n_cameras},
      {"pixels", s.pixels},
      {"unseen", s.outcome.n_unseen},
      {"weight_share", s.outcome.weight_share},
      {"lowest_score", s.outcome.lowest_score},
      {"lost", s.lost},
      {"scale", {{"subnormal", s.n_scale_subnormal}, {"zero", s.n_scale_zero}}},
      {"seconds", {{"read", s.read_seconds}, {"render", s.render_seconds}, {"write", s.write_seconds}}}};
  return json.dump(2, ' ', true, nlohmann::json::error_handler_t::replace) + "\n";
}

std::string summary_text(const Options& o, const Summary& s) {
  const double share = s.n_source > 0 ? static_cast<double>(s.outcome.n_kept) / static_cast<double>(s.n_source) : 1;
  const std::string lost =
      s.lost.empty() ? "" : fmt::format("  lost      not in the ply file: {}\n", fmt::join(s.lost, ", "));
  const std::string limits =
      s.n_scale_subnormal + s.n_scale_zero == 0
          ? ""
          : fmt::format("  limits    scales below FP16's normal range {}, flushed to 0 {}\n",
                        tool::format_count(s.n_scale_subnormal), tool::format_count(s.n_scale_zero));
  return fmt::format(
      "{} -> {}: {} of {} Gaussians ({:.1f} %), {:.3f} % of the weight blended into {} pictures of {} pixels\n"
      "  not seen  {} Gaussians; lowest {} kept {:.4g}\n"
      "{}{}  seconds   read {:.2f}, render {:.2f}, write {:.2f}\n",
      tool::printable(o.input), tool::printable(o.output), tool::format_count(s.outcome.n_kept),
      tool::format_count(s.n_source), 100 * share, 100 * s.outcome.weight_share, s.n_cameras,
      tool::format_count(s.pixels), tool::format_count(s.outcome.n_unseen), score_name(o.score), s.outcome.lowest_score,
      lost, limits, s.read_seconds, s.render_seconds, s.write_seconds);
}

int prune(const Options& o) {
  const unsigned threads =
      o.threads > 0 ? static_cast<unsigned>(o.threads) : std::max(1U, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
  const SplatFormat to = rgs::format_of_name(o.output);
  tool::InputFiles inputs;
  inputs.add_scene(o.input);
  inputs.add_cameras(o.cameras);
  if (const int code = check_outputs(o, inputs, to); code != tool::kSuccess) return code;

  const auto set = rgs::read_camera_set(o.cameras);
  if (!set) return tool::report(o.cameras, set.error());
  auto cameras = rgs::choose_cameras(*set, o.split, o.view);
  if (!cameras) return tool::report_usage(cameras.error());
  Summary summary;
  for (rgs::Camera& camera : *cameras) {
    if (!o.size.empty()) {
      const tool::ImageSize size = tool::parse_size(o.size).value();
      camera = rgs::resized(camera, size.width, size.height);
    }
    summary.pixels += static_cast<std::uint64_t>(camera.width) * static_cast<std::uint64_t>(camera.height);
  }
  summary.n_cameras = cameras->size();

  auto time = Clock::now();
  std::uint64_t hash = 0;
  auto file = read_scene(o, hash);
  // The scene is in memory now. A change of the file explains any error found in it.
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!file) return file.error();
  summary.format = rgs::format_name(file->format);
  summary.source_bytes = file->bytes;
  summary.n_source = file->cloud.size();
  summary.read_seconds = lap(time);

  tool::Progress progress(o.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
  const auto contributions = contributions_of(o, *file, *cameras, progress);
  if (!contributions) return contributions.error();
  summary.render_seconds = lap(time);
  if (!contributions->empty() && rgs::prune::outcome(*contributions, o.score, {}).n_unseen == contributions->size())
    return tool::report(o.cameras, {rgs::Errc::bad_argument, rgs::Error::kNone,
                                    "no camera sees any Gaussian: do the cameras belong to this scene?"});

  const auto kept = o.min_contribution ? rgs::prune::at_least(*contributions, o.score, *o.min_contribution)
                                       : rgs::prune::highest(*contributions, o.score, o.keep.of(summary.n_source));
  summary.outcome = rgs::prune::outcome(*contributions, o.score, kept);
  rgs::keep_splats(file->cloud, kept);
  if (!o.scores.empty()) {
    if (const auto written = write_scores(o, *contributions); !written) return written.error();
  }
  const auto written = write_scene(o, to, *std::move(file), kept, summary.n_source, hash, set->cameras);
  if (!written) return written.error();
  summary.output_bytes = written->output_bytes;
  summary.lost = written->lost;
  summary.n_scale_subnormal = written->declarations.n_scale_subnormal;
  summary.n_scale_zero = written->declarations.n_scale_zero;
  summary.write_seconds = lap(time);

  if (o.json) {
    tool::print(summary_json(o, summary));
  } else if (!o.quiet) {
    tool::print(summary_text(o, summary));
  }
  return tool::kSuccess;
}

void add_options(CLI::App& app, Options& o) {
  using rgs::math::AntiAliasing;
  using rgs::prune::Score;
  app.add_option("input", o.input, "scene, " + rgs::format_list() + "; its content decides")->required();
  app.add_option("output", o.output, "the pruned scene, .ply or .rgs")->required();
  app.add_option("--cameras,-c", o.cameras, "camera file or COLMAP folder (docs/user/CAMERAS.md)")->required();
  app.add_option("--split", o.split, "only these cameras; with train the test cameras are left to judge the result")
      ->check(CLI::IsMember({"train", "test"}));
  app.add_option("--view", o.view, "camera by name or index in the split, or all")->capture_default_str();
  app.add_option("--size", o.size, "WxH pixels, e.g. 640x480; keeps the horizontal field of view [the cameras' own]");
  auto* const keep = app.add_option("--keep", o.keep_text, "how many: 20% of all, or a number such as 100000 or 100k");
  app.add_option("--min-contribution", o.min_contribution, "instead of --keep: all that score at least this")
      ->check(CLI::NonNegativeNumber)
      ->excludes(keep);
  app.add_option("--score", o.score, "weight summed over all pixels: sum, or the largest in any pixel: max [sum]")
      ->transform(tool::one_of<Score>({{"sum", Score::sum}, {"max", Score::max}}));
  app.add_option("--scores", o.scores, "also write sum and max of every Gaussian of the input, NumPy float64 [n, 2]");
  app.add_option("--low-pass", o.render.low_pass, "px^2 added to projected covariances [the file's, else 0.3, mip 0.1]")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--aa,--aa-mode", o.render.anti_aliasing, "anti-aliasing: classic, mip [the file's, else classic]")
      ->transform(tool::one_of<AntiAliasing>({{"classic", AntiAliasing::classic},
                                              {"mip", AntiAliasing::mip_splatting},
                                              {"mip-splatting", AntiAliasing::mip_splatting}}));
  app.add_option("--threads", o.threads, "CPU threads, 0 for all cores; the output does not depend on it")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  tool::add_max_expansion(app, o.read.limits);
  tool::add_spz_axes(app, o.read.spz_axes);
  app.add_flag("--overwrite", o.overwrite, "replace existing outputs");
  app.add_flag("--no-sync", o.no_sync, "do not wait until files are on disk");
  app.add_flag("--json", o.json, "summary as JSON on standard output");
  app.add_flag("--quiet,-q", o.quiet, "no progress and no summary");
  app.set_version_flag("--version", "rgs-prune " RGS_VERSION);
  app.footer("Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input.");
}

// Values that the parser of arguments does not know; empty if all are right.
std::string read_values(Options& o) {
  if (!o.size.empty() && !tool::parse_size(o.size)) return "--size takes WxH, sides 1 to 65536, not '" + o.size + "'";
  if (o.keep_text.empty() && !o.min_contribution) return "--keep or --min-contribution is required";
  if (o.keep_text.empty()) return {};
  const auto keep = rgs::prune::parse_keep(o.keep_text);
  if (!keep) return "--keep takes a percentage up to 100% or a number, not '" + o.keep_text + "'";
  o.keep = *keep;
  return {};
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options options;
    CLI::App app{"Keeps the Gaussians of a scene that contribute most to the pictures of given cameras.", "rgs-prune"};
    add_options(app, options);
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    if (const std::string wrong = read_values(options); !wrong.empty()) return tool::report_usage(wrong);
    return prune(options);
  });
}
