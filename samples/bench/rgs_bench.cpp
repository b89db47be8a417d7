// rgs_bench.cpp - rgs-bench: the time and quality of each step of the method on this GPU.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "bench_plot.hpp"
#include "bench_report.hpp"
#include "bench_run.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "ppm_file.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/version.hpp"
#include "stress_views.hpp"

namespace {

namespace tool = rgs::tool;
using rgs::Result;
using rgs::bench::Configuration;
using rgs::bench::Report;
using Print = void(std::string_view);

struct Options {
  std::string scene, source, cameras, quality_cameras, photos, pixel_format = "rgb32f", views = "cameras";
  std::vector<std::string> sizes{"1920x1080", "3840x2160"}, modes{"baseline", "paper", "turbo"};
  std::string exp, key;
  std::string json, csv, svg;
  int frames = 100, orbit = 0;
  double orbit_step = 0.25;
  float detail_px = rgs::kDefaultDetailPx;
  bool asks_baseline = false;  // by name, or by --ablate
  bool ablate = false, roofline = false, overwrite = false;
  rgs::DecodeLimits limits;

  bool is_stress() const { return views == "stress"; }
};

// Outputs are opened before anything is measured, so that a bad name costs no minutes.
struct Output {
  std::string path;
  rgs::AtomicFile file;
  std::string (*text)(const Report&);
};

// The exit code of a failure already reported.
using Step = tl::expected<void, int>;
tl::unexpected<int> failed(const std::string& file, const rgs::Error& error) {
  return tl::unexpected<int>(tool::report(file, error));
}

// An .rgs file or a PLY, by content: other readers would need more libraries on machines with a GPU.
Result<rgs::Scene> load_source(const std::string& path, const rgs::DecodeLimits& limits) {
  auto scene = rgs::Scene::load(path, limits);
  if (scene || scene.error().code != rgs::Errc::bad_magic) return scene;
  const auto ply = rgs::PlyFile::open(path);
  if (!ply) return tl::unexpected(ply.error());
  auto cloud = rgs::read_cloud(*ply);
  if (!cloud) return tl::unexpected(cloud.error());
  scene = rgs::Scene::load(*std::move(cloud), ply->declarations());
  if (!scene && scene.error().code == rgs::Errc::bad_value) {
    rgs::Error error = scene.error();
    std::swap(error.found, error.offset);  // an index, not a byte of the file
    return tl::unexpected(error);
  }
  return scene;
}

// `has_levels`: whether the scene can be drawn by more than its leaves.
std::vector<Configuration> configurations(const Options& o, const std::optional<rgs::Declarations>& declared,
                                          bool has_levels) {
  rgs::bench::ModeInput input{declared, {}, {}};
  if (has_levels) input.detail_px = o.detail_px;
  if (!o.exp.empty()) {
    input.exp = o.exp == "exact"   ? rgs::math::Exp::exact
                : o.exp == "paper" ? rgs::math::Exp::paper
                                   : rgs::math::Exp::zero_mean;
  }
  if (!o.key.empty()) input.depth_mapping = o.key == "log" ? rgs::DepthMapping::logarithmic : rgs::DepthMapping::linear;
  std::vector<Configuration> rows;
  if (o.ablate) rows = rgs::bench::ablation(input);
  for (const std::string& mode : rgs::bench::compared_modes(o.modes, o.is_stress(), !has_levels || o.detail_px == 0)) {
    // The ablation begins with the baseline and ends with the paper's mode, under a name of its own.
    if (!(o.ablate && (mode == "baseline" || mode == "paper"))) rows.push_back(rgs::bench::make_mode(mode, input));
  }
  for (Configuration& row : rows) {
    if (o.pixel_format != "rgb32f") {
      row.packed = o.pixel_format == "rgba8" ? rgs::math::PixelFormat::rgba8 : rgs::math::PixelFormat::rgba16f;
    }
  }
  return rows;
}

// The scene on the device in the forms to draw, and the facts behind stress views.
struct LoadedScenes {
  rgs::bench::DeviceScenes device;
  rgs::bench::StressScene stress;
};

Result<rgs::DeviceScene> upload_plain(std::span<const std::byte> bytes, const Options& o) {
  const auto view = rgs::FileView::open(bytes, o.limits);
  if (!view) return tl::unexpected(view.error());
  return rgs::DeviceScene::upload(*view);
}

Result<rgs::DeviceScene> upload_levels(std::span<const std::byte> bytes, const Options& o, Report& report) {
  const auto file = rgs::PagedFile::open(bytes, o.limits);
  if (!file) return tl::unexpected(file.error());
  report.levels = {file->n_levels(), file->n_pages(), file->n_stored(), o.detail_px};
  return rgs::DeviceScene::upload(*file);
}

// Fills in the report and the modes that draw them.
tl::expected<LoadedScenes, int> load_scenes(const Options& o, Report& report) {
  LoadedScenes result;
  rgs::bench::DeviceScenes& scenes = result.device;
  const auto file = rgs::MappedFile::open(o.scene);
  if (!file) return failed(o.scene, file.error());
  const bool has_levels = rgs::has_levels(file->bytes());
  auto compact = has_levels ? upload_levels(file->bytes(), o, report) : upload_plain(file->bytes(), o);
  if (!compact) return failed(o.scene, compact.error());
  scenes.compact = *compact;
  const std::optional<rgs::Declarations>& declared = scenes.compact.declarations();
  const std::vector<Configuration> rows = configurations(o, declared, has_levels);
  for (const Configuration& row : rows) report.modes.push_back({row, {}});
  const std::string source = o.source.empty() ? o.scene : o.source;
  const auto loaded = load_source(source, o.limits);
  if (!loaded) return failed(source, loaded.error());
  const auto arrays = loaded->view();
  if (!arrays) return failed(source, arrays.error());
  if (rgs::bench::reads_fp32(rows)) {
    auto fp32 = rgs::DeviceScene::upload(*arrays);
    if (!fp32) return failed(source, fp32.error());
    scenes.fp32 = *fp32;
  }
  report.scene = std::filesystem::path(o.scene).filename().string();
  report.source = std::filesystem::path(source).filename().string();
  report.gaussians = scenes.compact.size();
  report.sh_degree = scenes.compact.sh_degree();
  if (o.is_stress()) {
    result.stress = rgs::bench::stress_scene(*declared, arrays->mean, arrays->origin);
    const glm::dvec3& dense = result.stress.dense;
    report.stress = {result.stress.size(), {dense.x, dense.y, dense.z}};
  }
  return result;
}

// Quality cameras and, if asked for, their photographs.
struct Views {
  std::vector<rgs::Camera> cameras;
  std::vector<rgs::Image> photos;
};

tl::expected<Views, int> load_views(const Options& o) {
  Views views;
  if (o.quality_cameras.empty()) return views;
  const auto set = rgs::read_camera_set(o.quality_cameras);
  if (!set) return failed(o.quality_cameras, set.error());
  for (std::size_t i = 0; i < set->cameras.size(); ++i) {
    if (set->split[i] == rgs::Split::test) views.cameras.push_back(set->cameras[i]);
  }
  if (o.photos.empty()) return views;
  for (const rgs::Camera& camera : views.cameras) {
    const std::string path = rgs::bench::photo_path(o.photos, camera);
    auto photo = rgs::bench::read_ppm(path);
    if (photo && (photo->width != camera.width || photo->height != camera.height)) {
      photo =
          rgs::make_error(rgs::Errc::size_mismatch, rgs::Error::kNone, "the photograph and its camera differ in size");
    }
    if (!photo) return failed(path, photo.error());
    views.photos.push_back(std::move(*photo));
  }
  return views;
}

Step measure_quality(const rgs::bench::DeviceScenes& scenes, const Views& views, Report& report) {
  if (views.cameras.empty()) return {};
  std::vector<rgs::Image> baseline;
  for (rgs::bench::ModeReport& mode : report.modes) {
    auto pictures = rgs::bench::pictures(mode.configuration, scenes, views.cameras);
    if (!pictures) return failed("", pictures.error());
    if (baseline.empty()) baseline = *pictures;
    const auto quality = rgs::bench::compare(baseline, *pictures, views.photos);
    if (!quality) return failed("", quality.error());
    mode.quality = *quality;
  }
  return {};
}

// One mode at a size.
rgs::Result<rgs::bench::Measurement> measure_mode(const Configuration& c, const rgs::bench::DeviceScenes& scenes,
                                                  std::span<const rgs::Camera> cameras,
                                                  const rgs::bench::Effort& effort) {
  const auto timing = rgs::bench::measure(c, scenes, cameras, effort);
  if (!timing) return tl::unexpected(timing.error());
  const rgs::Camera& camera = cameras.front();
  return rgs::bench::Measurement{
      *timing, rgs::bench::stage_costs({timing->mean, c.options, camera.width, camera.height, c.compact,
                                        scenes.of(c).sh_degree(), rgs::bench::pixel_bytes(c.packed)})};
}

// One size of all modes; rows are printed as they come.
Step measure_size(const rgs::bench::DeviceScenes& scenes, std::span<const rgs::Camera> cameras, tool::ImageSize size,
                  Print* print, Report& report) {
  std::vector<rgs::Camera> sized;
  for (const rgs::Camera& c : cameras) sized.push_back(rgs::resized(c, size.width, size.height));
  report.sizes.push_back({size.width, size.height, {}, {}});
  rgs::bench::SizeReport& rows = report.sizes.back();
  print(rgs::bench::size_text(rows, report));
  for (std::size_t row = 0; row < report.modes.size(); ++row) {
    const auto measured = measure_mode(report.modes[row].configuration, scenes, sized, {.frames = report.frames});
    if (!measured) return failed("", measured.error());
    rows.rows.push_back(*measured);
    print(rgs::bench::row_text(rows, row, report));
    tool::flush();
  }
  print(rgs::bench::outside_text(rows, report));
  print(rgs::bench::drawn_text(rows, report));
  return {};
}

// The fixed list, a line a view.
Step measure_stress(const LoadedScenes& scenes, std::span<const rgs::Camera> cameras, Print* print, Report& report) {
  constexpr double kSecondsPerMode = 2;
  const auto views = rgs::bench::stress_views(cameras, scenes.stress);
  report.n_cameras = views.front().cameras.size();
  print(rgs::bench::stress_head_text(report));
  for (const rgs::bench::StressView& view : views) {
    rgs::bench::SizeReport rows{view.width, view.height, view.name, {}};
    for (const rgs::bench::ModeReport& mode : report.modes) {
      const auto measured = measure_mode(mode.configuration, scenes.device, view.cameras,
                                         {.frames = report.frames, .seconds = kSecondsPerMode});
      if (!measured) {
        const std::string where =
            fmt::format("{} at {}x{}, {}", view.name, view.width, view.height, mode.configuration.name);
        return failed(where, measured.error());
      }
      rows.rows.push_back(*measured);
    }
    print(rgs::bench::stress_row_text(rows, report));
    tool::flush();
    report.sizes.push_back(std::move(rows));
  }
  return {};
}

void warn_of_coarse_depths(const Report& report) {
  for (const rgs::bench::SizeReport& size : report.sizes) {
    for (std::size_t row = 0; row < size.rows.size(); ++row) {
      tool::print_error(rgs::bench::coarse_depth_text(size, row, report));
    }
  }
}

// The gate of the stress views.
int judge(const Report& report) {
  if (!report.stress) return tool::kSuccess;
  const auto slower = rgs::bench::failed_views(report);
  for (const std::string& view : slower) tool::print_error("rgs-bench: turbo is slower than paper: " + view + "\n");
  return slower.empty() ? tool::kSuccess : tool::kGate;
}

// The first camera at the first size.
Step measure_orbit(const Options& o, const rgs::bench::DeviceScenes& scenes, const rgs::Camera& camera,
                   tool::ImageSize size, Print* print, Report& report) {
  std::vector<Configuration> modes;
  for (const rgs::bench::ModeReport& mode : report.modes) modes.push_back(mode.configuration);
  auto orbit = rgs::bench::orbit(modes, scenes, rgs::resized(camera, size.width, size.height), o.orbit_step, o.orbit);
  if (!orbit) return failed("", orbit.error());
  print(rgs::bench::orbit_text(*orbit));
  report.orbit = *std::move(orbit);
  return {};
}

tl::expected<std::vector<Output>, int> open_outputs(const Options& o) {
  const std::pair<const std::string&, std::string (*)(const Report&)> wanted[] = {
      {o.json, rgs::bench::report_json}, {o.csv, rgs::bench::report_csv}, {o.svg, rgs::bench::roofline_svg}};
  std::vector<Output> outputs;
  for (const auto& [path, text] : wanted) {
    if (path.empty()) continue;
    auto file = rgs::AtomicFile::create(path, {.overwrite = o.overwrite, .sync = true});
    if (!file) return failed(path, file.error());
    outputs.push_back({path, std::move(*file), text});
  }
  return outputs;
}

Step write(std::vector<Output>& outputs, const Report& report) {
  for (Output& output : outputs) {
    const std::string text = output.text(report);
    const auto written = output.file.write_at(0, std::as_bytes(std::span(text)));
    if (!written) return failed(output.path, written.error());
    const auto committed = output.file.commit();
    if (!committed) return failed(output.path, committed.error());
  }
  return {};
}

tl::expected<std::vector<tool::ImageSize>, int> parse_sizes(const Options& o) {
  std::vector<tool::ImageSize> sizes;
  for (const std::string& text : o.sizes) {
    const auto size = tool::parse_size(text);
    if (!size) return tl::unexpected<int>(tool::report_usage("--size takes WxH, not '" + text + "'"));
    sizes.push_back(*size);
  }
  return sizes;
}

// Checked before the device is used. An unreadable file is reported when it is read.
bool asks_baseline_of_levels(const Options& o) {
  if (o.detail_px == 0 || !o.asks_baseline) return false;
  const auto file = rgs::MappedFile::open(o.scene);
  return file && rgs::has_levels(file->bytes());
}

int bench(const Options& o) {
  const auto sizes = parse_sizes(o);
  if (!sizes) return sizes.error();
  if (asks_baseline_of_levels(o))
    return tool::report_usage("baseline draws the leaves alone: --detail 0, or --mode paper,turbo without --ablate");
  tool::InputFiles inputs;
  inputs.add(o.scene);
  inputs.add(o.source);
  inputs.add_cameras(o.cameras);
  inputs.add_cameras(o.quality_cameras);
  inputs.add_pictures(o.photos);
  const std::array output_paths{o.json, o.csv, o.svg};
  if (const int code = inputs.check_outputs(output_paths); code != tool::kSuccess) return code;
  auto outputs = open_outputs(o);
  if (!outputs) return outputs.error();
  Report report;
  report.version = RGS_VERSION;
  report.date = fmt::format("{:%Y-%m-%dT%H:%M:%SZ}",
                            fmt::gmtime(std::chrono::system_clock::to_time_t(std::chrono::system_clock::now())));
  report.frames = o.frames;
  const auto device = rgs::bench::device_info();
  if (!device) return tool::report("", device.error());
  report.device = *device;
  rgs::Result<std::vector<rgs::Camera>> cameras;  // none for stress views that are framed by the scene's box
  if (!o.cameras.empty()) cameras = rgs::read_cameras(o.cameras);
  if (!cameras) return tool::report(o.cameras, cameras.error());
  const auto is_pinhole = [](const rgs::Camera& camera) { return camera.model == rgs::CameraModel::pinhole; };
  if (o.is_stress() && !std::ranges::all_of(*cameras, is_pinhole))
    return tool::report_usage("--views stress takes pinhole cameras alone");
  report.n_cameras = cameras->size();
  const auto views = load_views(o);
  if (!views) return views.error();
  report.n_quality_cameras = views->cameras.size();
  const auto scenes = load_scenes(o, report);
  // Everything is on the device now. A changed file explains any error found in it.
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!scenes) return scenes.error();
  const bool floors = o.roofline || !o.svg.empty();
  if (floors) {
    const auto rates = rgs::cuda::measure_rates();
    if (!rates) return tool::report("", rates.error());
    report.rates = *rates;
  }

  // A report on standard output stays parseable.
  const bool piped = std::any_of(outputs->begin(), outputs->end(), [](const Output& out) { return out.path == "-"; });
  Print* const print = piped ? tool::print_error : tool::print;
  print(rgs::bench::header_text(report));
  if (const auto ok = measure_quality(scenes->device, *views, report); !ok) return ok.error();
  if (o.is_stress()) {
    if (const auto ok = measure_stress(*scenes, *cameras, print, report); !ok) return ok.error();
  } else {
    for (const tool::ImageSize& size : *sizes) {
      if (const auto ok = measure_size(scenes->device, *cameras, size, print, report); !ok) return ok.error();
    }
  }
  for (const rgs::bench::SizeReport& size : report.sizes) {
    if (floors) print(rgs::bench::roofline_text(size, report));
  }
  if (o.orbit > 0) {
    if (const auto ok = measure_orbit(o, scenes->device, cameras->front(), sizes->front(), print, report); !ok)
      return ok.error();
  }
  warn_of_coarse_depths(report);
  if (const auto ok = write(*outputs, report); !ok) return ok.error();
  return judge(report);
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options o;
    CLI::App app{"Measures the CUDA renderer: time, work and quality of each step of the method.", "rgs-bench"};
    app.set_version_flag("--version", "rgs-bench " RGS_VERSION);
    app.add_option("SCENE", o.scene, ".rgs file")->required();
    tool::add_max_expansion(app, o.limits);
    app.add_option("--source", o.source,
                   "3DGS .ply (or .rgs) the file was made from, for the baseline [the file itself]");
    app.add_option("--cameras,-c", o.cameras, "cameras to time (docs/user/CAMERAS.md); --views stress does without");
    app.add_option("--views", o.views,
                   "cameras: as they are; stress: a fixed list derived from them (far away, odd shapes, ...), in which "
                   "turbo must not be slower than paper (docs/user/BENCH_JSON.md)")
        ->check(CLI::IsMember({"cameras", "stress"}))
        ->capture_default_str();
    app.add_option("--quality-cameras", o.quality_cameras, "compare the test split of these cameras with the baseline");
    app.add_option("--photos", o.photos, "folder of photographs NAME.ppm of these cameras, binary PPM of their size");
    app.add_option("--size", o.sizes, "WxH,...")->delimiter(',')->capture_default_str();
    app.add_option("--mode", o.modes,
                   "modes to compare with the baseline, which is always measured (paper above detail 0); with --views "
                   "stress beside paper and turbo")
        ->delimiter(',')
        ->check(CLI::IsMember(rgs::bench::mode_names()))
        ->capture_default_str();
    app.add_option("--pixel-format", o.pixel_format, "pixels of timed frames: FP32 RGB or packed RGBA")
        ->check(CLI::IsMember({"rgb32f", "rgba16f", "rgba8"}))
        ->capture_default_str();
    app.add_option("--detail", o.detail_px,
                   "levels of detail: projected error allowed, px; 0 draws the leaves, the only choice of baseline and "
                   "--ablate draw (docs/develop/LEVELS.md)")
        ->check(CLI::NonNegativeNumber)
        ->capture_default_str();
    app.add_flag("--ablate", o.ablate, "all steps between baseline and paper");
    app.add_option("--frames", o.frames,
                   "frames per camera; with --views stress at most so many, and 2 s a view and mode")
        ->check(CLI::Range(1, 100000))
        ->capture_default_str();
    app.add_option("--exp", o.exp, "exponential of paper mode")->check(CLI::IsMember({"paper", "zero-mean", "exact"}));
    app.add_option("--key", o.key, "depth mapping of paper mode [the file's]")->check(CLI::IsMember({"linear", "log"}));
    app.add_option("--orbit", o.orbit, "also orbit what the first camera sees in so many frames, to find popping")
        ->check(CLI::Range(3, 100000));
    app.add_option("--orbit-step", o.orbit_step, "degrees from frame to frame")
        ->check(CLI::Range(-90.0, 90.0))
        ->capture_default_str();
    app.add_flag("--roofline", o.roofline, "measure the device's rates and compare each stage with its floor");
    app.add_option("--json", o.json, "write all of it as JSON (docs/user/BENCH_JSON.md); - is standard output");
    app.add_option("--csv", o.csv, "write a line for each size and mode");
    app.add_option("--svg", o.svg, "write the roofline as a picture; implies --roofline");
    app.add_flag("--overwrite", o.overwrite, "replace existing outputs");
    app.footer(
        "Exit codes: 0 done, 1 internal, 2 usage, 3 input/output or device, 4 malformed input, 5 turbo is slower than "
        "paper in a stress view.");
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    const bool is_stress = o.is_stress();
    if (!is_stress && o.cameras.empty()) return tool::report_usage("--cameras is required except with --views stress");
    for (const char* option :
         {"--size", "--ablate", "--orbit", "--quality-cameras", "--photos", "--roofline", "--svg"}) {
      if (is_stress && app.get_option(option)->count() > 0)
        return tool::report_usage(fmt::format("--views stress takes no {}: its list is fixed", option));
    }
    const bool asks_modes = app.get_option("--mode")->count() > 0;
    o.asks_baseline =
        o.ablate || (asks_modes && std::find(o.modes.begin(), o.modes.end(), "baseline") != o.modes.end());
    if (is_stress && !asks_modes) o.modes.clear();
    if (!o.photos.empty() && o.quality_cameras.empty()) return tool::report_usage("--photos needs --quality-cameras");
    return bench(o);
  });
}
