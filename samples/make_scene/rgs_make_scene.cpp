// rgs_make_scene.cpp - rgs-make-scene: writes a deterministic synthetic scene of any size as a 3DGS PLY, or as an .rgs
// with levels of detail.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/blocked_range.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "command_line.hpp"
#include "conformance_files.hpp"
#include "console.hpp"
#include "convert.hpp"
#include "garden_generator.hpp"
#include "input_files.hpp"
#include "rgs/ply.hpp"
#include "rgs/version.hpp"
#include "scene_generator.hpp"
#include "town_generator.hpp"

namespace {

namespace tool = rgs::tool;

constexpr std::uint64_t kBatch = 2048;  // Gaussians: 0.5 MB as Splat, as much again encoded, per thread

struct Options {
  std::string output, conformance, cameras, camera_path, gaussians = "200k";
  rgs::Origin origin = rgs::kNoOrigin;
  std::string scratch;
  std::uint64_t seed = 1, memory_bytes = rgs::lod::kDefaultMemory;
  int degree = 3, blocks = 0;
  unsigned threads = 0;
  bool town = false, garden = false, overwrite = false, quiet = false, no_sync = false;
};

// A text file beside the scene, created before the work begins so that an obstacle shows at once.
class TextFile {
 public:
  // Reports errors and returns the exit code; an empty path writes nothing.
  int create(const std::string& path, const rgs::AtomicFile::Options& options) {
    path_ = path;
    if (path.empty()) return tool::kSuccess;
    rgs::Result<rgs::AtomicFile> file = rgs::AtomicFile::create(path, options);
    if (!file) return tool::report(path, file.error());
    file_ = std::move(*file);
    return tool::kSuccess;
  }
  int write(const std::string& text) {
    if (path_.empty()) return tool::kSuccess;
    rgs::Status written = file_.write_at(0, std::as_bytes(std::span(text)));
    if (written) written = file_.commit().map([](double) {});
    return written ? tool::kSuccess : tool::report(path_, written.error());
  }

 private:
  std::string path_;
  rgs::AtomicFile file_;
};

// Writes Gaussians 0 .. count - 1 of `source` to rows first, first + 1, ... in batches, on all threads.
template <class Source>
rgs::Status write_batches(const Source& source, std::uint64_t first, std::uint64_t count, rgs::PlyWriter& writer,
                          tool::Progress& progress) {
  rgs::Status status;
  std::mutex mutex;
  tbb::task_group_context context;
  const std::uint64_t n_batches = (count + kBatch - 1) / kBatch;
  tbb::parallel_for(
      tbb::blocked_range<std::uint64_t>(0, n_batches, 4),
      [&](const tbb::blocked_range<std::uint64_t>& range) {
        std::vector<rgs::Splat> splats;
        for (std::uint64_t batch = range.begin(); batch != range.end() && !context.is_group_execution_cancelled();
             ++batch) {
          const std::uint64_t start = batch * kBatch;
          splats.resize(std::min(kBatch, count - start));
          source.generate(start, splats);
          if (rgs::Status written = writer.write(first + start, splats); !written) {
            const std::lock_guard lock(mutex);
            if (status) status = written;
            context.cancel_group_execution();
          }
          progress.advance(splats.size());
        }
      },
      tbb::auto_partitioner{}, context);
  return status;
}

// The same for a town: ranges in parallel and the batches of a range in parallel, because either may be few.
rgs::Status write_town(const rgs::TownGenerator& town, rgs::PlyWriter& writer, tool::Progress& progress) {
  rgs::Status status;
  std::mutex mutex;
  tbb::task_group_context context;
  tbb::parallel_for(
      tbb::blocked_range<std::uint64_t>(0, town.n_ranges(), 1),
      [&](const tbb::blocked_range<std::uint64_t>& ranges) {
        for (std::uint64_t k = ranges.begin(); k != ranges.end() && !context.is_group_execution_cancelled(); ++k) {
          const rgs::TownRange range = town.range(k);
          rgs::Status written;
          // Isolated: a thread that waits for a range's batches begins no other range.
          tbb::this_task_arena::isolate(
              [&] { written = write_batches(range, town.first(k), range.size(), writer, progress); });
          if (!written) {
            const std::lock_guard lock(mutex);
            if (status) status = written;
            context.cancel_group_execution();
          }
        }
      },
      tbb::simple_partitioner{}, context);
  return status;
}

// The Gaussians of `source` from stream position `before` on, block by block.
template <class Source>
rgs::Status visit_blocks(const Source& source, std::uint64_t before, std::uint64_t count,
                         const rgs::lod::SplatStream::Visit& visit) {
  constexpr std::uint64_t kRows = 32 * kBatch;
  std::vector<rgs::Splat> rows;
  for (std::uint64_t first = 0; first < count; first += kRows) {
    rows.resize(std::min(kRows, count - first));
    tbb::parallel_for(std::uint64_t{0}, (rows.size() + kBatch - 1) / kBatch, [&](std::uint64_t batch) {
      const std::uint64_t start = batch * kBatch;
      source.generate(first + start, std::span(rows).subspan(start, std::min(kBatch, rows.size() - start)));
    });
    if (rgs::Status s = visit(before + first, rows); !s) return s;
  }
  return {};
}

rgs::lod::SplatStream stream_of(const Options& options, std::uint64_t n) {
  const auto stream = [&](auto scene) -> rgs::lod::SplatStream {
    return {n, options.degree, [scene, n](const auto& visit) { return visit_blocks(scene, 0, n, visit); }};
  };
  if (options.garden) return stream(rgs::GardenGenerator(options.seed, n, options.degree));
  if (!options.town) return stream(rgs::SceneGenerator(options.seed, n, options.degree));
  const rgs::TownGenerator town(options.seed, n, options.degree, options.blocks);
  return {n, options.degree, [town](const rgs::lod::SplatStream::Visit& visit) -> rgs::Status {
            for (std::uint64_t k = 0; k < town.n_ranges(); ++k) {
              const rgs::TownRange range = town.range(k);
              if (rgs::Status s = visit_blocks(range, town.first(k), range.size(), visit); !s) return s;
            }
            return {};
          }};
}

// The scene as an .rgs with levels. It is never in memory as a whole: each pass of the builder makes it anew.
int write_levels(const Options& options, std::uint64_t n, const rgs::AtomicFile::Options& file_options) {
  rgs::ConvertOptions convert;
  convert.encode.profile = rgs::Profile::packed;
  convert.encode.metres_per_unit = options.town ? 1.F : 0.F;
  convert.levels = rgs::lod::Quality::fast;
  convert.memory_bytes = options.memory_bytes;
  convert.scratch =
      options.scratch.empty() ? std::filesystem::path(options.output).parent_path().string() : options.scratch;
  convert.output = file_options;
  rgs::StreamFacts facts;
  facts.origin = options.origin;
  rgs::Result<rgs::ConvertSummary> summary;
  {
    tool::Progress progress(options.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    rgs::StageObserver observer;
    observer.begin = [&](const char* stage, std::uint64_t total, const char* unit) {
      progress.begin(stage, total, unit);
    };
    observer.advance = [&](std::uint64_t units) { progress.advance(units); };
    observer.finish = [&] { progress.finish(); };
    summary = rgs::convert_to_levels(stream_of(options, n), facts, options.output, convert, observer);
  }
  if (!summary) return tool::report(options.output, summary.error());
  if (!options.quiet) {
    tool::print(fmt::format("{}: {} Gaussians, SH degree {}, seed {}, {} levels in {} pages, {}\n",
                            tool::printable(options.output), tool::format_count(n), options.degree, options.seed,
                            summary->n_levels, tool::format_count(summary->n_pages),
                            tool::format_bytes(summary->output_bytes)));
  }
  return tool::kSuccess;
}

int write_views(const Options& options, TextFile& cameras, TextFile& camera_path) {
  const int width = 1280, height = 720;
  if (const int code = cameras.write(options.town ? rgs::town_cameras_json(options.seed, width, height, options.origin)
                                     : options.garden ? rgs::garden_cameras_json(width, height, options.origin)
                                                      : rgs::scene_cameras_json(width, height, options.origin));
      code != tool::kSuccess)
    return code;
  if (!options.town) return tool::kSuccess;
  return camera_path.write(rgs::town_path_json(options.seed, width, height, options.origin));
}

int make_scene(const Options& options, std::uint64_t n) {
  const bool levels = options.output.ends_with(".rgs");
  if (levels && n == 0) return tool::report_usage("an .rgs with levels of detail has at least one Gaussian");
  if (options.memory_bytes < rgs::lod::kLeastMemory) return tool::report_usage("--memory takes at least 128MiB");
  if (!levels && (!options.scratch.empty() || options.memory_bytes != rgs::lod::kDefaultMemory))
    return tool::report_usage("--memory and --scratch are for .rgs outputs");
  const rgs::AtomicFile::Options file_options{options.overwrite, !options.no_sync};
  const bool piped = options.output == "-" || options.cameras == "-" ||
                     options.camera_path == "-";  // then text goes to standard error
  const std::array<std::string, 4> outputs{options.output, options.cameras, options.camera_path,
                                           piped || options.quiet ? "" : "-"};
  if (const int code = tool::InputFiles().check_outputs(outputs); code != tool::kSuccess) return code;
  const unsigned threads = options.threads > 0 ? options.threads : std::max(1U, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);

  rgs::Declarations stated;
  stated.origin = options.origin;
  if (options.town) stated.metres_per_unit = 1;
  TextFile cameras, camera_path;
  if (const int code = cameras.create(options.cameras, file_options); code != tool::kSuccess) return code;
  if (const int code = camera_path.create(options.camera_path, file_options); code != tool::kSuccess) return code;
  if (levels) {
    // Cameras first, as below, once the scene's output is open.
    if (const auto probe = rgs::AtomicFile::create(options.output, file_options); !probe)
      return tool::report(options.output, probe.error());
    if (const int code = write_views(options, cameras, camera_path); code != tool::kSuccess) return code;
    return write_levels(options, n, file_options);
  }
  rgs::Result<rgs::PlyWriter> writer = rgs::PlyWriter::create(options.output, n, options.degree, file_options, stated);
  if (!writer) return tool::report(options.output, writer.error());
  tool::Progress progress(options.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
  progress.begin("writing", n, "Gaussians");
  const rgs::Status rows =
      options.town ? write_town(rgs::TownGenerator(options.seed, n, options.degree, options.blocks), *writer, progress)
      : options.garden ? write_batches(rgs::GardenGenerator(options.seed, n, options.degree), 0, n, *writer, progress)
                       : write_batches(rgs::SceneGenerator(options.seed, n, options.degree), 0, n, *writer, progress);
  if (!rows) return tool::report(options.output, rows.error());
  // Cameras first: a failure there leaves no scene without its cameras.
  if (const int code = write_views(options, cameras, camera_path); code != tool::kSuccess) return code;
  if (rgs::Result<double> synced = writer->commit(); !synced) return tool::report(options.output, synced.error());
  progress.finish();

  if (!options.quiet) {
    const std::uint64_t bytes =
        rgs::ply_header(n, options.degree, stated).size() + n * rgs::ply_row_bytes(options.degree, options.origin);
    (piped ? tool::print_error
           : tool::print)(fmt::format("{}: {} Gaussians, SH degree {}, seed {}, {}\n", tool::printable(options.output),
                                      tool::format_count(n), options.degree, options.seed, tool::format_bytes(bytes)));
  }
  return tool::kSuccess;
}

int parse_and_make_scene(int argc, char** argv) {
  Options options;
  CLI::App app{
      "Writes a deterministic synthetic scene (a house, a town, or a garden) as a 3DGS PLY, or as an "
      ".rgs with levels of detail.",
      "rgs-make-scene"};
  app.add_option("output", options.output,
                 "file to write: .rgs with levels of detail (docs/develop/LEVELS.md), else PLY");
  app.add_option(
         "--conformance", options.conformance,
         "write 24 scenes of a few Gaussians with reference pictures to this folder instead, for tests of other "
         "renderers; of the other options --overwrite, --no-sync and --quiet count")
      ->option_text("FOLDER");
  app.add_option("--seed", options.seed, "another seed, another scene")->capture_default_str();
  app.add_option("--gaussians", options.gaussians,
                 "number of Gaussians, up to 200M, a town up to 1G; suffixes k, M and G")
      ->capture_default_str();
  auto* const town = app.add_flag("--town", options.town,
                                  "a town of streets, houses, gardens and trees under a wide sky, in metres; more "
                                  "Gaussians make it larger and finer");
  app.add_flag("--garden", options.garden,
               "a garden of many small Gaussians on a grid, so that lists are long as in dense trained scenes; more "
               "Gaussians make it finer")
      ->excludes(town);
  app.add_option(
         "--blocks", options.blocks,
         "blocks along each side of the town, 1 to 64; each measures about 78 x 64 m. By default 4 for 1M, 8 for "
         "20M, 13 for 100M, 22 for 1G Gaussians")
      ->check(CLI::Range(1, rgs::kMaxTownBlocks))
      ->needs(town);
  app.add_option("--degree", options.degree, "degree of the spherical harmonics")
      ->check(CLI::Range(0, rgs::kMaxShDegree))
      ->capture_default_str();
  app.add_option("--cameras", options.cameras, "also write eight views of the scene to this JSON file");
  app.add_option("--camera-path", options.camera_path,
                 "also write 600 cameras of a flight through the town to this JSON file: along a street, then over the "
                 "roofs, 30 m/s at 60 frames a second")
      ->needs(town);
  app.add_option("--origin", options.origin,
                 "world position x,y,z of the scene's middle; then coordinates are double, as those of "
                 "georeferenced scenes")
      ->delimiter(',')
      ->check(CLI::Range(-rgs::kMaxOrigin, rgs::kMaxOrigin))
      ->option_text("X,Y,Z");
  tool::add_bytes(app, "--memory", options.memory_bytes, "memory for building an .rgs, at least 128MiB [2GiB]");
  app.add_option("--scratch", options.scratch, "folder for temporary files of an .rgs [the output's]");
  app.add_option("--threads", options.threads, "threads, 0 for all cores; the output does not depend on it")
      ->check(CLI::Range(0U, 1024U))
      ->capture_default_str();
  app.add_flag("--overwrite", options.overwrite, "replace existing outputs");
  app.add_flag("--no-sync", options.no_sync, "do not wait until the files are on the disk");
  app.add_flag("--quiet,-q", options.quiet, "print errors only");
  app.set_version_flag("--version", "rgs-make-scene " RGS_VERSION);
  app.footer("Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output.");
  if (const auto code = tool::parse(app, argc, argv)) return *code;
  if (!options.conformance.empty()) {
    const std::array<std::string, 4> allowed{"--conformance", "--overwrite", "--no-sync", "--quiet"};
    for (const CLI::Option* option : app.get_options())
      if (option->count() > 0 && std::ranges::find(allowed, option->get_name()) == allowed.end())
        return tool::report_usage("--conformance goes without " + option->get_name());
    return rgs::write_conformance(options.conformance, {options.overwrite, !options.no_sync}, options.quiet);
  }
  if (options.output.empty()) return tool::report_usage("name the file to write, or a folder with --conformance");
  const rgs::Result<std::uint64_t> n = tool::parse_count(options.gaussians);
  if (!n || *n > (options.town ? rgs::kMaxTownGaussians : rgs::kMaxSceneGaussians))
    return tool::report_usage(fmt::format("--gaussians takes a whole number from 0 to {}, not '{}'",
                                          options.town ? "1G" : "200M", options.gaussians));
  return make_scene(options, *n);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&] { return parse_and_make_scene(argc, argv); });
}
