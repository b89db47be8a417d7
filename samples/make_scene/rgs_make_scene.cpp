// rgs_make_scene.cpp - rgs-make-scene: writes a deterministic synthetic scene of any size as a 3DGS PLY.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/blocked_range.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "rgs/ply.hpp"
#include "rgs/version.hpp"
#include "scene_generator.hpp"

namespace {

namespace tool = rgs::tool;

constexpr std::uint64_t kBatch = 2048;  // Gaussians: 0.5 MB as Splat, as much again encoded, per thread

struct Options {
  std::string output, cameras, gaussians = "200k";
  rgs::Origin origin = rgs::kNoOrigin;
  std::uint64_t seed = 1;
  int degree = 3;
  unsigned threads = 0;
  bool overwrite = false, quiet = false, no_sync = false;
};

rgs::Status write_text(const std::string& path, const std::string& text, const rgs::AtomicFile::Options& options) {
  rgs::Result<rgs::AtomicFile> file = rgs::AtomicFile::create(path, options);
  if (!file) return tl::unexpected(file.error());
  if (rgs::Status written = file->write_at(0, std::as_bytes(std::span(text))); !written) return written;
  return file->commit().map([](double) {});
}

rgs::Status write_scene(const rgs::SceneGenerator& scene, rgs::PlyWriter& writer, tool::Progress& progress) {
  rgs::Status status;
  std::mutex mutex;
  tbb::task_group_context context;
  const std::uint64_t n_batches = (scene.size() + kBatch - 1) / kBatch;
  tbb::parallel_for(
      tbb::blocked_range<std::uint64_t>(0, n_batches, 4),
      [&](const tbb::blocked_range<std::uint64_t>& range) {
        std::vector<rgs::Splat> splats;
        for (std::uint64_t batch = range.begin(); batch != range.end() && !context.is_group_execution_cancelled();
             ++batch) {
          const std::uint64_t first = batch * kBatch;
          splats.resize(std::min(kBatch, scene.size() - first));
          scene.generate(first, splats);
          if (rgs::Status written = writer.write(first, splats); !written) {
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

int make_scene(const Options& options, std::uint64_t n) {
  const rgs::AtomicFile::Options file_options{options.overwrite, !options.no_sync};
  const bool piped = options.output == "-" || options.cameras == "-";  // then text goes elsewhere
  const std::array<std::string, 3> outputs{options.output, options.cameras, piped || options.quiet ? "" : "-"};
  if (const int code = tool::InputFiles().check_outputs(outputs); code != tool::kSuccess) return code;
  const unsigned threads = options.threads > 0 ? options.threads : std::max(1U, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);

  rgs::Declarations stated;
  stated.origin = options.origin;
  rgs::Result<rgs::PlyWriter> writer = rgs::PlyWriter::create(options.output, n, options.degree, file_options, stated);
  if (!writer) return tool::report(options.output, writer.error());
  const rgs::SceneGenerator scene(options.seed, n, options.degree);
  tool::Progress progress(options.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
  progress.begin("writing", n, "Gaussians");
  if (rgs::Status written = write_scene(scene, *writer, progress); !written)
    return tool::report(options.output, written.error());
  // Cameras first: a failure there leaves no scene without the cameras that were asked for.
  if (!options.cameras.empty()) {
    if (rgs::Status written =
            write_text(options.cameras, rgs::scene_cameras_json(1280, 720, options.origin), file_options);
        !written)
      return tool::report(options.cameras, written.error());
  }
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
  CLI::App app{"Writes a deterministic synthetic scene (a house in a garden under a wide sky) as a 3DGS PLY.",
               "rgs-make-scene"};
  app.add_option("output", options.output, "PLY file to write")->required();
  app.add_option("--seed", options.seed, "another seed, another scene")->capture_default_str();
  app.add_option("--gaussians", options.gaussians, "number of Gaussians, 0 to 200M; suffixes k and M")
      ->capture_default_str();
  app.add_option("--degree", options.degree, "degree of the spherical harmonics")
      ->check(CLI::Range(0, rgs::kMaxShDegree))
      ->capture_default_str();
  app.add_option("--cameras", options.cameras, "also write eight views of the scene to this JSON file");
  app.add_option("--origin", options.origin,
                 "where the scene's middle lies in the world, x,y,z; then coordinates are double, as those of "
                 "georeferenced scenes")
      ->delimiter(',')
      ->check(CLI::Range(-rgs::kMaxOrigin, rgs::kMaxOrigin))
      ->option_text("X,Y,Z");
  app.add_option("--threads", options.threads, "threads, 0 for all cores; the output does not depend on it")
      ->check(CLI::Range(0U, 1024U))
      ->capture_default_str();
  app.add_flag("--overwrite", options.overwrite, "replace existing outputs");
  app.add_flag("--no-sync", options.no_sync, "do not wait until the files are on the disk");
  app.add_flag("--quiet,-q", options.quiet, "print errors only");
  app.set_version_flag("--version", "rgs-make-scene " RGS_VERSION);
  app.footer("Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output.");
  if (const auto code = tool::parse(app, argc, argv)) return *code;
  const rgs::Result<std::uint64_t> n = tool::parse_count(options.gaussians);
  if (!n || *n > rgs::kMaxSceneGaussians)
    return tool::report_usage(
        fmt::format("--gaussians takes a whole number from 0 to 200M, not '{}'", options.gaussians));
  return make_scene(options, *n);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&] { return parse_and_make_scene(argc, argv); });
}
