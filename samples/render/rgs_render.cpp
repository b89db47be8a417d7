// rgs_render.cpp - rgs-render: pictures of a scene from camera files, along paths or on an orbit.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <deque>
#include <filesystem>
#include <future>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include "camera_choice.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "image_file.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "pace.hpp"
#include "rgs/ablation.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene_first_view.hpp"
#include "rgs/utf8_path.hpp"
#include "rgs/version.hpp"
#include "scene_file.hpp"
#include "spz_axes.hpp"

namespace {

namespace fs = std::filesystem;
namespace tool = rgs::tool;
using Clock = std::chrono::steady_clock;

struct Options {
  rgs::ReadOptions read;
  std::string scene, cameras, view, split, size, out, depth, path;
  std::string format = "png";
  int orbit = 0, frames = 120;
  bool alpha = false, overwrite = false, quiet = false, json = false, scalar = false;
  std::vector<float> depth_range;
  std::string key = "exact";
  bool has_arithmetic = false;  // an option that excludes --mode was given
  // For streamed scenes: addresses, and paths with a budget.
  std::optional<std::uint64_t> host_memory, device_memory;
  std::optional<double> wait, realtime;  // seconds; frames a second
  rgs::RendererOptions renderer;
  // The image definition's steps, changed by single options; unread without any.
  rgs::RenderOptions render{.paper = {.depth_order = rgs::math::DepthOrder::exact,
                                      .exponent = rgs::math::Exponent::direct,
                                      .exp = rgs::math::Exp::exact}};
};

// One picture to make.
struct Shot {
  rgs::Camera camera;
  std::string out, depth;  // files; empty if not requested
};

// The result of a shot.
struct Frame {
  const Shot* shot;
  rgs::FrameStats stats;
  double draw_ms = 0;  // in the renderer, with copies to the host
  // Streamed scenes, ms: waited for pages; due and actual begin after the first frame.
  double wait_ms = 0, due_ms = 0, begin_ms = 0;
};

constexpr double kDefaultWait = 60;  // seconds a frame
constexpr int kWarmUps = 3;          // frames
constexpr std::size_t kWaitingBytes = 512 << 20;
constexpr std::size_t kDeviceShots = 8;  // at a time, of several devices each

bool is_streamed(const Options& options) {
  return options.host_memory || options.device_memory || rgs::is_url(options.scene);
}

// The scene's public name: an address without user, password, query and fragment.
std::string shown_scene(const Options& options) {
  std::string name = options.scene;
  if (!rgs::is_url(name)) return name;
  name.resize(std::min(name.find_first_of("?#"), name.size()));
  const std::size_t host = name.find("//") + 2;
  const std::size_t at = name.substr(0, name.find('/', host)).rfind('@');
  if (at != std::string::npos) name.erase(host, at + 1 - host);
  return name;
}

double seconds_since(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

bool names_picture(const std::string& path) {
  return rgs::image_format(path).has_value();
}

// Names every shot's files, in folders or as the single file given. Returns an exit code.
int name_files(std::vector<Shot>& shots, const Options& options) {
  for (const std::string* target : {&options.out, &options.depth}) {
    if (target->empty()) continue;
    const bool depth = target == &options.depth;
    std::string Shot::*field = depth ? &Shot::depth : &Shot::out;
    if (names_picture(*target)) {
      if (shots.size() != 1)
        return tool::report_usage(
            fmt::format("{} pictures do not fit into the file '{}': name a folder, or choose one "
                        "camera with --view",
                        shots.size(), *target));
      shots.front().*field = *target;
    } else {
      if (rgs::detail::path_of(*target).has_extension() && !fs::is_directory(rgs::detail::path_of(*target)))
        return tool::report_usage("'" + *target + "' ends neither as a picture (.png .jpg .tif .exr) nor as a folder");
      std::error_code failed;
      fs::create_directories(rgs::detail::path_of(*target), failed);
      if (failed)
        return tool::report(*target, {rgs::Errc::write_failed, rgs::Error::kNone, "cannot make the folder",
                                      rgs::Error::kNone, rgs::Error::kNone, failed.value()});
      std::set<std::string> used;
      for (std::size_t i = 0; i < shots.size(); ++i) {
        std::string stem = rgs::picture_stem(shots[i].camera, i);
        if (!used.insert(stem).second) used.insert(stem += fmt::format("_{:04}", i));
        const std::string name = depth ? stem + "_depth.exr" : stem + "." + options.format;
        shots[i].*field = (rgs::detail::path_of(*target) / name).string();
      }
    }
    // Reported before the first frame is rendered, not after the last.
    for (const Shot& shot : shots) {
      std::error_code ignored;
      if (const auto known = rgs::load_image_format(*rgs::image_format(shot.*field)); !known)
        return tool::report(shot.*field, known.error());
      if (!options.overwrite && fs::exists(rgs::detail::path_of(shot.*field), ignored))
        return tool::report(shot.*field, {rgs::Errc::output_exists, rgs::Error::kNone,
                                          "the output exists; pass --overwrite to replace it"});
    }
  }
  return tool::kSuccess;
}

// Cameras of all pictures, at their final size, from the options and, for views without cameras, from the scene.
// `scene` may be streamed. Returns an exit code.
int make_shots(const Options& options, const rgs::Scene& scene, const glm::dvec3& scene_up, std::vector<Shot>& shots) {
  rgs::ViewFormat format;
  tool::ImageSize size;
  if (!options.size.empty()) {
    size = tool::parse_size(options.size).value();
    format.width = size.width;
    format.height = size.height;
  }
  std::vector<rgs::Camera> cameras;
  if (!options.path.empty()) {
    const auto keys = rgs::read_cameras(options.path);
    if (!keys) return tool::report(options.path, keys.error());
    cameras = rgs::interpolated_path(*keys, options.frames);
  } else {
    glm::dvec3 up = scene_up;
    bool exact_up = false;
    if (!options.cameras.empty()) {
      const auto set = rgs::read_camera_set(options.cameras);
      if (!set) return tool::report(options.cameras, set.error());
      if (options.orbit > 0) {
        up = rgs::mean_up(set->cameras);
        exact_up = true;
      } else {
        const std::string view = !options.view.empty() ? options.view : names_picture(options.out) ? "0" : "all";
        auto chosen = rgs::choose_cameras(*set, options.split, view);
        if (!chosen) return tool::report_usage(chosen.error());
        cameras = *std::move(chosen);
      }
    }
    if (cameras.empty()) {
      const auto view = rgs::first_view(scene, up, exact_up);
      if (!view) return tool::report(options.scene, view.error());
      cameras = rgs::orbit(*view, scene.origin(), std::max(options.orbit, 1), format);
      for (std::size_t i = 0; i < cameras.size(); ++i)
        cameras[i].name = options.orbit > 0 ? fmt::format("orbit_{:04}", i) : "view";
    }
  }
  // Zero-padded, so that a list of the folder is in the order of the path.
  if (!options.path.empty())
    for (std::size_t i = 0; i < cameras.size(); ++i) cameras[i].name = fmt::format("frame_{:04}", i);
  for (rgs::Camera& camera : cameras)
    shots.push_back({size.width > 0 ? rgs::resized(camera, size.width, size.height) : camera, {}, {}});
  return name_files(shots, options);
}

rgs::RenderOptions render_options(const Options& options) {
  rgs::RenderOptions render = options.render;
  if (options.has_arithmetic) {
    render.pipeline = rgs::Pipeline::paper;
    const bool is_exact = options.key == "exact";
    render.paper.depth_order = is_exact ? rgs::math::DepthOrder::exact : rgs::math::DepthOrder::quantized;
    render.paper.depth_mapping = options.key == "log" ? rgs::DepthMapping::logarithmic : rgs::DepthMapping::linear;
    if (options.depth_range.size() == 2) render.paper.depth_range = {options.depth_range[0], options.depth_range[1]};
  } else {
    render.paper = {};
  }
  return render;
}

// A rendered frame on its way to its files.
struct Picture {
  rgs::Image colour, depth;
};

// The i-th of n images that lie one below the other.
rgs::Image nth(rgs::Image& all, std::size_t i, std::size_t n) {
  if (n == 1 || all.pixels.empty()) return std::move(all);
  rgs::Image one = rgs::Image::make(all.width, all.height / static_cast<int>(n), all.channels);
  std::ranges::copy(std::span(all.pixels).subspan(i * one.pixels.size(), one.pixels.size()), one.pixels.begin());
  return one;
}

// Frames of one size.
rgs::Result<std::vector<Picture>> render_shots(rgs::Renderer& renderer, const rgs::Scene& scene,
                                               const rgs::RenderOptions& options, bool with_alpha,
                                               std::span<Frame> frames) {
  const std::size_t n = frames.size();
  std::vector<rgs::Camera> cameras;
  cameras.reserve(n);
  for (const Frame& frame : frames) cameras.push_back(frame.shot->camera);
  const int width = cameras.front().width, height = cameras.front().height * static_cast<int>(n);
  rgs::Image colour = rgs::Image::make(width, height, 3), alpha, depth;
  rgs::PictureArrays arrays;
  arrays.rgb = colour.pixels.data();
  if (with_alpha) {
    alpha = rgs::Image::make(width, height, 1);
    arrays.alpha = alpha.pixels.data();
  }
  if (!frames.front().shot->depth.empty()) {
    depth = rgs::Image::make(width, height, 1);
    arrays.depth = depth.pixels.data();
  }
  const auto begin = Clock::now();
  const auto rendered = renderer.render_all(scene, cameras, arrays, options);
  if (!rendered) return tl::unexpected(rendered.error());
  const double draw_ms = 1e3 * seconds_since(begin) / static_cast<double>(n);
  std::vector<Picture> pictures(n);
  for (std::size_t i = 0; i < n; ++i) {
    frames[i].stats = (*rendered)[i];
    frames[i].draw_ms = draw_ms;
    pictures[i] = {nth(colour, i, n), nth(depth, i, n)};
    if (with_alpha) pictures[i].colour = rgs::with_alpha(pictures[i].colour, nth(alpha, i, n).pixels);
  }
  return pictures;
}

// Writes a frame's files; reports an error itself and returns the exit code.
int write_shot(const Shot& shot, const Picture& picture, bool overwrite) {
  rgs::ImageFileOptions options;
  options.file.overwrite = overwrite;
  options.software = "rgs-render " RGS_VERSION;
  if (!shot.out.empty())
    if (const auto written = rgs::write_image(shot.out, picture.colour, options); !written)
      return tool::report(shot.out, written.error());
  options.depth = true;
  if (!shot.depth.empty())
    if (const auto written = rgs::write_image(shot.depth, picture.depth, options); !written)
      return tool::report(shot.depth, written.error());
  return tool::kSuccess;
}

double median_ms(const std::vector<Frame>& frames) {
  std::vector<double> times;
  for (const Frame& frame : frames) times.push_back(frame.stats.total_ms);
  const auto middle = times.begin() + static_cast<std::ptrdiff_t>(times.size() / 2);
  std::nth_element(times.begin(), middle, times.end());
  return *middle;
}

// Facts of the scene for the summary.
struct SceneFacts {
  std::uint64_t file_bytes, gaussians, memory_bytes;
  int sh_degree;
  std::uint64_t budget = 0;  // streamed scenes
  std::uint64_t device_budget = 0, device_bytes = 0;
};

nlohmann::json stream_json(const Options& options, const Frame& frame) {
  const rgs::StreamStats& s = frame.stats.stream;
  nlohmann::json stream{{"pages_resident", s.pages_resident},
                        {"pages_missing", s.pages_missing},
                        {"bytes_read", s.bytes_read},
                        {"bytes_decoded", s.bytes_decoded},
                        {"bytes_uploaded", s.bytes_uploaded},
                        {"bytes_evicted", s.bytes_evicted},
                        {"detail_reached_px", s.detail_reached_px}};
  if (options.realtime) {
    stream["due_ms"] = frame.due_ms;
    stream["begin_ms"] = frame.begin_ms;
  } else {
    stream["wait_ms"] = frame.wait_ms;
  }
  return stream;
}

struct Drawn {
  std::vector<Frame> frames;
  double first_frame_ms = 0;     // since `opened`: what a viewer waits for
  std::size_t n_incomplete = 0;  // coarser than asked for: pages are missing, or there was no time for them
  // In real time.
  int n_late = 0;
  double reached_fps = 0;
};

nlohmann::json summary(const Options& options, const SceneFacts& scene, const rgs::Renderer& renderer,
                       const Drawn& drawn, double load_seconds, double total_seconds) {
  const std::vector<Frame>& frames = drawn.frames;
  nlohmann::json pictures = nlohmann::json::array();
  for (const Frame& frame : frames) {
    const rgs::FrameStats& s = frame.stats;
    nlohmann::json picture{{"camera", frame.shot->camera.name},
                           {"width", frame.shot->camera.width},
                           {"height", frame.shot->camera.height},
                           {"ms",
                            {{"total", s.total_ms},
                             {"project", s.project_ms},
                             {"sort", s.sort_ms},
                             {"bin", s.bin_ms},
                             {"blend", s.blend_ms}}},
                           {"gaussians", s.gaussians},
                           {"pages", s.pages},
                           {"detail_px", s.detail_px},
                           {"visible", s.visible},
                           {"instances", s.instances},
                           {"evaluated", s.evaluated},
                           {"blended", s.blended},
                           {"workspace_bytes", s.bytes},
                           {"depth_bits", s.depth_bits},
                           {"depth_resolution", s.depth_resolution}};
    if (is_streamed(options)) picture["stream"] = stream_json(options, frame);
    if (!frame.shot->out.empty()) picture["file"] = frame.shot->out;
    if (!frame.shot->depth.empty()) picture["depth_file"] = frame.shot->depth;
    pictures.push_back(std::move(picture));
  }
  nlohmann::json all{{"program", "rgs-render"},
                     {"version", RGS_VERSION},
                     {"scene",
                      {{"file", shown_scene(options)},
                       {"bytes", scene.file_bytes},
                       {"gaussians", scene.gaussians},
                       {"sh_degree", scene.sh_degree},
                       {"memory_bytes", scene.memory_bytes}}},
                     {"backend", renderer.backend_name()},
                     {"load_seconds", load_seconds},
                     {"first_frame_ms", drawn.first_frame_ms},
                     {"total_seconds", total_seconds},
                     {"median_ms", median_ms(frames)},
                     {"frames_incomplete", drawn.n_incomplete},
                     {"frames", std::move(pictures)}};
  if (is_streamed(options)) {
    all["host_memory"] = scene.budget;
    if (options.device_memory) {
      all["device_memory"] = scene.device_budget;
      all["scene"]["device_bytes"] = scene.device_bytes;
    }
    if (options.realtime) {
      all["realtime_fps"] = *options.realtime;
      all["reached_fps"] = drawn.reached_fps;
      all["frames_late"] = drawn.n_late;
    } else {
      all["wait_seconds"] = options.wait.value_or(kDefaultWait);
    }
  }
  return all;
}

void print_summary(const Options& options, const SceneFacts& scene, const rgs::Renderer& renderer, const Drawn& drawn,
                   double load_seconds, double total_seconds) {
  const std::vector<Frame>& frames = drawn.frames;
  if (options.json) {
    const auto text = summary(options, scene, renderer, drawn, load_seconds, total_seconds)
                          .dump(2, ' ', true, nlohmann::json::error_handler_t::replace);
    tool::print(text + "\n");
  } else if (!options.quiet) {
    tool::print(fmt::format("{}: {} Gaussians, SH degree {}, {} in {}\n", tool::printable(shown_scene(options)),
                            tool::format_count(scene.gaussians), scene.sh_degree,
                            is_streamed(options) ? "opened" : "loaded", tool::format_seconds(load_seconds)));
    for (const Frame& frame : frames) {
      tool::print(fmt::format("{}  {}x{}  {}  {} visible", tool::printable(frame.shot->out), frame.shot->camera.width,
                              frame.shot->camera.height, tool::format_seconds(frame.stats.total_ms * 1e-3),
                              tool::format_count(frame.stats.visible)));
      const rgs::StreamStats& s = frame.stats.stream;
      if (is_streamed(options)) {
        tool::print(
            fmt::format("  {} of {} pages{}  error {:.3g} px", tool::format_count(frame.stats.pages),
                        tool::format_count(s.pages_resident),
                        s.pages_missing == 0 ? "" : fmt::format(", {} missing", tool::format_count(s.pages_missing)),
                        s.detail_reached_px));
      }
      tool::print("\n");
    }
    if (is_streamed(options)) {
      const rgs::StreamStats& s = frames.back().stats.stream;
      tool::print(fmt::format("read {}, decoded {}, evicted {}; {} of {} held{}\n", tool::format_bytes(s.bytes_read),
                              tool::format_bytes(s.bytes_decoded), tool::format_bytes(s.bytes_evicted),
                              tool::format_bytes(scene.memory_bytes), tool::format_bytes(scene.budget),
                              scene.device_budget == 0
                                  ? ""
                                  : fmt::format(", on the device {} of {}", tool::format_bytes(scene.device_bytes),
                                                tool::format_bytes(scene.device_budget))));
    }
    tool::print(fmt::format("{} {}: median {} a frame, {} in all\n", frames.size(),
                            frames.size() == 1 ? "picture" : "pictures", tool::format_seconds(median_ms(frames) * 1e-3),
                            tool::format_seconds(total_seconds)));
  }
}

void warn_of_missing_pages(const std::string& path, const rgs::Scene& scene) {
  const rgs::PagedFile* levels = scene.levels();
  if (levels == nullptr || levels->n_present() == levels->n_pages()) return;
  tool::print_error(
      fmt::format("rgs-render: {}: the end of the file is missing: drew the {} of its {} pages that are present, in "
                  "less detail\n",
                  tool::printable(path), levels->n_present(), levels->n_pages()));
}

// For the frame with the coarsest depth key.
void warn_of_coarse_depths(const std::vector<Frame>& frames) {
  const auto coarsest =
      std::ranges::max_element(frames, {}, [](const Frame& frame) { return frame.stats.depth_resolution; });
  const rgs::FrameStats& s = coarsest->stats;
  if (s.depth_resolution < rgs::kCoarseDepthResolution) return;
  tool::print_error(fmt::format(
      "rgs-render: {}: the depth key of {} bits resolves {:.2g} of the depth, coarser than {:g}: "
      "Gaussians may be drawn out of order (docs/format/RENDERING.md, \"Depth resolution\")\n",
      tool::printable(coarsest->shot->camera.name), s.depth_bits, s.depth_resolution, rgs::kCoarseDepthResolution));
}

// Draws and writes every shot, between begin(frame, options) and is_complete(frame). A picture is encoded while the next
// frame is rendered; at most two are in memory. In real time no frame waits for the one before to be encoded or for the
// disk, up to kWaitingBytes of pictures. Several devices draw as many together, at least one each. Returns an exit
// code.
template <class Begin, class IsComplete>
int draw_frames(const Options& options, rgs::Renderer& renderer, const rgs::Scene& scene,
                const std::vector<Shot>& shots, Clock::time_point opened, const Begin& begin,
                const IsComplete& is_complete, Drawn& drawn) {
  rgs::RenderOptions how = render_options(options);
  tool::Progress progress(options.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
  progress.begin("rendering", shots.size(), "frames");
  const rgs::Camera& camera = shots.front().camera;
  const auto picture_bytes = static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height) * 16;
  const std::size_t n_waiting = kWaitingBytes / picture_bytes, n_devices = options.renderer.devices.size();
  const std::size_t n_at_once = n_devices > 1 ? std::clamp(n_waiting, n_devices, kDeviceShots * n_devices) : 1;
  const std::size_t n_writers = options.realtime ? std::clamp<std::size_t>(n_waiting, 1, 32) : n_at_once;
  std::deque<std::future<int>> writing;
  for (auto next = shots.begin(); next != shots.end();) {
    const rgs::Camera& size = next->camera;
    std::vector<Frame> frames;
    while (next != shots.end() && frames.size() < n_at_once && next->camera.width == size.width &&
           next->camera.height == size.height) {
      begin(frames.emplace_back(Frame{&*next++, {}}), how);
    }
    auto pictures = render_shots(renderer, scene, how, options.alpha, frames);
    if (!pictures) return tool::report(size.name, pictures.error());
    if (drawn.first_frame_ms == 0) drawn.first_frame_ms = 1e3 * seconds_since(opened);
    for (std::size_t i = 0; i < frames.size(); ++i) {
      if (!is_complete(frames[i])) ++drawn.n_incomplete;
      if (writing.size() == n_writers) {
        if (const int code = writing.front().get(); code != tool::kSuccess) return code;
        writing.pop_front();
      }
      // If no thread can be started it is written once later frames are rendered. Named, and so copied: libstdc++ would
      // have moved it into the thread that does not start.
      const auto write = [shot = frames[i].shot, &options,
                          done = std::make_shared<const Picture>(std::move((*pictures)[i]))] {
        return write_shot(*shot, *done, options.overwrite);
      };
      writing.push_back(std::async(std::launch::async | std::launch::deferred, write));
      drawn.frames.push_back(frames[i]);
      progress.advance(1);
    }
  }
  for (std::future<int>& one : writing) {
    if (const int code = one.get(); code != tool::kSuccess) return code;
  }
  progress.finish();
  return tool::kSuccess;
}

// Of a run that wrote every picture.
int exit_code(const Drawn& drawn) {
  return drawn.n_incomplete == 0 ? tool::kSuccess : tool::kIncomplete;
}

int render(const Options& options) {
  const auto start = Clock::now();
  tool::InputFiles inputs;
  inputs.add_scene(options.scene);
  inputs.add_cameras(options.cameras);
  inputs.add_cameras(options.path);
  auto renderer = rgs::Renderer::create(options.renderer);
  if (!renderer) return tool::report("", renderer.error());
  const auto opened = Clock::now();
  const auto scene = rgs::open_scene_file(options.scene, options.read);
  rgs::Status prepared;
  // The CPU expands only the pages that it draws.
  const bool is_whole = scene && (scene->scene.levels() == nullptr || renderer->backend() == rgs::Backend::cuda);
  if (is_whole) prepared = renderer->prepare(scene->scene);
  // A changed file explains any error found in it.
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!scene) return tool::report(options.scene, scene.error());
  if (!prepared) return tool::report(options.scene, prepared.error());
  const double load_seconds = seconds_since(start);
  if (!options.quiet) warn_of_missing_pages(options.scene, scene->scene);

  std::vector<Shot> shots;
  if (const int code = make_shots(options, scene->scene, scene->up, shots); code != tool::kSuccess) return code;
  std::vector<std::string> outputs{options.json || !options.quiet ? "-" : ""};
  for (const Shot& shot : shots) outputs.insert(outputs.end(), {shot.out, shot.depth});
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  Drawn drawn;
  const auto nothing = [](const Frame&, const rgs::RenderOptions&) {};
  const auto is_complete = [](const Frame& frame) { return frame.stats.stream.pages_missing == 0; };
  if (const int code = draw_frames(options, *renderer, scene->scene, shots, opened, nothing, is_complete, drawn);
      code != tool::kSuccess)
    return code;
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess)
    return code;  // reading goes on while a scene is drawn

  if (!options.quiet) warn_of_coarse_depths(drawn.frames);
  const double total_seconds = seconds_since(start);
  const SceneFacts facts{scene->file_bytes, scene->scene.size(), scene->scene.bytes(), scene->scene.sh_degree()};
  print_summary(options, facts, *renderer, drawn, load_seconds, total_seconds);
  return exit_code(drawn);
}

// Reports a file that cannot be streamed and what to do. Returns an exit code.
int report_not_streamed(const Options& options, const rgs::Error& error) {
  const bool is_other = error.code == rgs::Errc::missing_section || error.code == rgs::Errc::bad_magic;
  if (!is_other) return tool::report(shown_scene(options), error);
  if (rgs::is_url(options.scene)) {
    return tool::report(shown_scene(options),
                        {rgs::Errc::unsupported_feature, rgs::Error::kNone,
                         "is not an .rgs file with levels of detail; only these are read from a web server: "
                         "download it first"});
  }
  const std::string option = options.device_memory ? "--device-memory" : "--host-memory";
  return tool::report_usage(option + " streams .rgs files with levels of detail, which '" + options.scene +
                            "' is not: rgs-convert --lod makes one, and without " + option + " it is drawn as a whole");
}

void warn_of_incomplete_frame(const Frame& frame, const rgs::Status& why) {
  const rgs::StreamStats& s = frame.stats.stream;
  const std::string lacks = s.pages_missing == 0 ? "the table of pages is not verified"
                                                 : fmt::format("{} pages are missing", s.pages_missing);
  tool::print_error(fmt::format("rgs-render: {}: {}, its error is {:.3g} px{}{}\n",
                                tool::printable(frame.shot->camera.name), lacks, s.detail_reached_px, why ? "" : ": ",
                                why ? "" : tool::describe(why.error())));
}

void warn_of_late_frames(const Options& options, const Drawn& drawn) {
  if (drawn.n_late == 0 && drawn.n_incomplete == 0) return;
  const auto coarsest =
      std::ranges::max_element(drawn.frames, {}, [](const Frame& frame) { return frame.stats.detail_px; });
  tool::print_error(fmt::format(
      "rgs-render: of {} frames {} began late, {} are coarser than asked for: {:.3g} of {:g} frames a second, in a "
      "detail of up to {:.3g} px\n",
      drawn.frames.size(), drawn.n_late, drawn.n_incomplete, drawn.reached_fps, *options.realtime,
      coarsest->stats.detail_px));
}

// Frames of a streamed scene: each complete, or each at its time.
int render_streamed(const Options& options) {
  const auto start = Clock::now();
  tool::InputFiles inputs;
  if (!rgs::is_url(options.scene)) inputs.add_scene(options.scene);
  inputs.add_cameras(options.cameras);
  inputs.add_cameras(options.path);
  rgs::RendererOptions how = options.renderer;
  // It is drawn where its pages are.
  if (how.backend == rgs::Backend::automatic)
    how.backend = options.device_memory ? rgs::Backend::cuda : rgs::Backend::cpu;
  if (how.backend == rgs::Backend::cuda && !options.device_memory)
    return tool::report_usage("streaming to the GPU needs --device-memory; without it use --backend cpu");
  if (how.backend == rgs::Backend::cpu && options.device_memory)
    return tool::report_usage("--device-memory needs the GPU: use --backend cuda, or --host-memory alone");
  auto renderer = rgs::Renderer::create(how);
  if (!renderer) return tool::report("", renderer.error());
  const auto opened = Clock::now();
  rgs::StreamPoolOptions budget;
  if (options.host_memory) budget.host_memory = *options.host_memory;
  if (options.device_memory) budget.device_memory = *options.device_memory;
  const auto pool = rgs::StreamPool::create(budget);
  if (!pool) return tool::report("", pool.error());
  rgs::UrlOptions way;
  if (const double most = options.wait.value_or(0); most > 0) way.open_seconds = std::min(most, 86400.);
  auto source = rgs::open_source(options.scene, way);
  if (!source) return tool::report(shown_scene(options), source.error());
  const std::uint64_t file_bytes = (*source)->size();
  way.open_seconds -= seconds_since(opened);
  const auto scene = rgs::Scene::open(*std::move(source), {.pool = *pool, .limits = options.read.limits, .url = way});
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!scene) return report_not_streamed(options, scene.error());
  const double load_seconds = seconds_since(start);

  std::vector<Shot> shots;
  const glm::dvec3 up = rgs::declared_up(*scene->declarations());
  if (const int code = make_shots(options, *scene, up, shots); code != tool::kSuccess) return code;
  std::vector<std::string> outputs{options.json || !options.quiet ? "-" : ""};
  for (const Shot& shot : shots) outputs.insert(outputs.end(), {shot.out, shot.depth});
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;

  bool is_refined = true;
  rgs::Status why;
  Drawn drawn;
  const rgs::RenderOptions asked = render_options(options);
  const bool keeps_time = asked.pipeline != rgs::Pipeline::baseline;  // which draws the leaves alone
  const float detail = asked.detail_px.value_or(keeps_time ? rgs::kDefaultDetailPx : 0);
  rgs::render::Pace pace(options.realtime.value_or(1));
  std::optional<Clock::time_point> flight;
  // Before the clock starts, the renderer makes its workspace and learns what a frame costs, and the libraries that
  // encode pictures are loaded, which can take seconds.
  for (int n = 0; options.realtime && n < kWarmUps; ++n) {
    Frame frame{&shots.front(), {}};
    rgs::RenderOptions warm_up = asked;
    if (keeps_time) warm_up.frame_ms = pace.draw_ms();
    const auto picture = render_shots(*renderer, *scene, warm_up, options.alpha, {&frame, 1});
    if (!picture) return tool::report(frame.shot->camera.name, picture.error());
    if (n > 0) continue;
    drawn.first_frame_ms = 1e3 * seconds_since(opened);
    const auto encoded = rgs::encode_image(picture->front().colour, rgs::ImageFormat::png);
    if (!encoded) return tool::report(frame.shot->out, encoded.error());
  }
  const auto begin = [&](Frame& frame, rgs::RenderOptions& render_how) {
    if (options.realtime) {
      if (!flight) flight = Clock::now();
      frame.due_ms = pace.begin(drawn.frames.empty() ? 0 : 1e3 * seconds_since(*flight));
      std::this_thread::sleep_until(
          *flight + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1e-3 * frame.due_ms)));
      frame.begin_ms = 1e3 * seconds_since(*flight);
      if (keeps_time) render_how.frame_ms = pace.draw_ms();
      return;
    }
    const auto waiting = Clock::now();
    const auto refined = renderer->refine(*scene, frame.shot->camera, options.wait.value_or(kDefaultWait), render_how);
    // A wrong request has no picture; a damaged file still has one.
    why = refined ? rgs::Status() : tl::unexpected(refined.error());
    is_refined = refined && *refined;
    frame.wait_ms = 1e3 * seconds_since(waiting);
  };
  const auto is_complete = [&](const Frame& frame) {
    const bool has_pages = frame.stats.stream.pages_missing == 0;
    if (options.realtime) {
      pace.drew(frame.draw_ms);
      return has_pages && frame.stats.detail_px <= detail;
    }
    if (has_pages && is_refined) return true;
    if (!options.quiet) warn_of_incomplete_frame(frame, why);
    return false;
  };
  if (const int code = draw_frames(options, *renderer, *scene, shots, opened, begin, is_complete, drawn);
      code != tool::kSuccess)
    return code;
  if (options.realtime) {
    drawn.n_late = pace.n_late();
    drawn.reached_fps = static_cast<double>(drawn.frames.size()) / seconds_since(*flight);
    if (!options.quiet) warn_of_late_frames(options, drawn);
  }
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!options.quiet) warn_of_coarse_depths(drawn.frames);
  const SceneFacts facts{file_bytes,          scene->size(),         pool->host_bytes(),  scene->sh_degree(),
                         pool->host_memory(), pool->device_memory(), pool->device_bytes()};
  print_summary(options, facts, *renderer, drawn, load_seconds, seconds_since(start));
  const rgs::Status status = scene->status();
  if (status || !options.realtime) return exit_code(drawn);
  if (!options.quiet)
    tool::print_error(
        fmt::format("rgs-render: {}: {}\n", tool::printable(shown_scene(options)), tool::describe(status.error())));
  return tool::kIncomplete;
}

void add_options(CLI::App& app, Options& o) {
  using namespace rgs::math;
  app.add_option("scene", o.scene,
                 "scene to render, " + rgs::format_list() +
                     ", told by its content; or the http(s) address of an .rgs with levels of detail")
      ->required();
  app.add_option("--out,-o", o.out, "picture (.png .jpg .tif .exr) or folder for pictures")->required();
  app.add_option("--cameras,-c", o.cameras, "camera file or COLMAP folder (docs/user/CAMERAS.md)");
  app.add_option("--view", o.view, "camera by name or index in the split, or all [all for a folder, 0 for a file]");
  app.add_option("--split", o.split, "only these cameras")->check(CLI::IsMember({"train", "test"}));
  app.add_option("--size", o.size, "WxH pixels, e.g. 1920x1080; keeps the horizontal field of view");
  app.add_option("--orbit", o.orbit, "N views on a circle around the scene")->check(CLI::Range(1, 1'000'000));
  app.add_option("--path", o.path, "smooth path through the cameras of this file")->excludes("--orbit");
  app.add_option("--frames", o.frames, "pictures along --path")
      ->check(CLI::Range(1, 1'000'000))
      ->capture_default_str()
      ->needs("--path");
  app.add_option("--format", o.format, "format of pictures in a folder")
      ->check(CLI::IsMember({"png", "jpg", "tif", "exr"}))
      ->capture_default_str();
  app.add_option("--depth", o.depth, "also expected depth: picture (.exr .tif) or folder");
  app.add_flag("--alpha", o.alpha, "transparent background: pictures with an alpha channel (.png .tif .exr)");
  app.add_flag("--overwrite", o.overwrite, "replace existing pictures");

  const std::string stream = "Streaming, of .rgs files with levels of detail (docs/develop/STREAMING.md)";
  tool::add_bytes(app, "--host-memory", o.host_memory,
                  "stream the pages that the views want, within this budget [2GiB for addresses; paths are read whole]")
      ->group(stream);
  tool::add_bytes(app, "--device-memory", o.device_memory,
                  "the same on the GPU, half for pages, half for the frames' workspace; what does not fit is coarser")
      ->group(stream);
  auto* const wait =
      app.add_option(
             "--wait", o.wait,
             "seconds to wait for the opening of an address, and for each frame before it is drawn incomplete [60]; 0: "
             "draw what the opening has read")
          ->check(CLI::Range(0.0, 1e6))
          ->group(stream);
  app.add_option("--realtime", o.realtime,
                 "frames of --path a second, drawn on time from the resident pages; coarser where time is short")
      ->check(CLI::Range(0.001, 1e4))
      ->needs("--path")
      ->excludes(wait)
      ->group(stream);

  const std::string image = "Image";
  app.add_option("--background", o.render.background, "R,G,B behind the scene, 0 to 1 [0,0,0]")
      ->delimiter(',')
      ->excludes("--alpha")
      ->group(image);
  app.add_option("--near", o.render.near_plane, "nothing is drawn at or below this depth")
      ->check(CLI::PositiveNumber)
      ->capture_default_str()
      ->group(image);
  app.add_option("--far", o.render.far_plane, "nothing is drawn above this depth, 0 for no limit")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str()
      ->group(image);
  app.add_option("--sh-degree", o.render.sh_degree_limit, "ignore higher degrees")
      ->check(CLI::Range(0, rgs::kMaxShDegree))
      ->capture_default_str()
      ->group(image);
  app.add_option("--detail", o.render.detail_px,
                 "levels of detail: projected error allowed, px [1]; 0 draws the leaves (docs/develop/LEVELS.md)")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--max-gaussians", o.render.max_gaussians,
                 "levels of detail: coarser than --detail where that draws more Gaussians, in all directions");
  app.add_option("--low-pass", o.render.low_pass,
                 "px^2 added to projected covariances [as declared, else 0.3, mip 0.1]")
      ->check(CLI::NonNegativeNumber)
      ->group(image);
  app.add_option("--aa,--aa-mode", o.render.anti_aliasing, "anti-aliasing: classic, mip [as declared, else classic]")
      ->transform(tool::one_of<AntiAliasing>({{"classic", AntiAliasing::classic},
                                              {"mip", AntiAliasing::mip_splatting},
                                              {"mip-splatting", AntiAliasing::mip_splatting}}))
      ->group(image);

  const std::string arithmetic = "Arithmetic (docs/format/RENDERING.md)";
  auto* const mode =
      app.add_option("--mode", o.render.pipeline, "all of these at once: baseline (3DGS), paper, turbo [turbo on CUDA]")
          ->transform(tool::one_of<rgs::Pipeline>({{"baseline", rgs::Pipeline::baseline},
                                                   {"paper", rgs::Pipeline::paper},
                                                   {"turbo", rgs::Pipeline::turbo}}))
          ->group(arithmetic);
  app.add_option("--extent", o.render.paper.extent, "tiles of a Gaussian: ellipse, square [ellipse]")
      ->transform(tool::one_of<Extent>({{"ellipse", Extent::ellipse}, {"square", Extent::square}}))
      ->excludes(mode)
      ->group(arithmetic);
  app.add_option("--key", o.key, "depth order: exact, or quantised: linear, log")
      ->check(CLI::IsMember({"exact", "linear", "log"}))
      ->capture_default_str()
      ->excludes(mode)
      ->group(arithmetic);
  app.add_option("--depth-bits", o.render.paper.depth_bits,
                 "bits of the quantised depth, 0: 32 minus those of the tile")
      ->check(CLI::Range(0, 32))
      ->capture_default_str()
      ->excludes(mode)
      ->group(arithmetic);
  app.add_option("--depth-range", o.depth_range, "NEAR,FAR of the quantised depth [as declared, else 0.2,100]")
      ->delimiter(',')
      ->expected(2)
      ->excludes(mode)
      ->group(arithmetic);
  app.add_option("--exponent", o.render.paper.exponent, "direct, folded [direct]")
      ->transform(tool::one_of<Exponent>({{"direct", Exponent::direct}, {"folded", Exponent::folded}}))
      ->excludes(mode)
      ->group(arithmetic);
  app.add_option("--exp", o.render.paper.exp, "exponential: exact, paper, zero-mean [exact]")
      ->transform(tool::one_of<Exp>({{"exact", Exp::exact}, {"paper", Exp::paper}, {"zero-mean", Exp::zero_mean}}))
      ->excludes(mode)
      ->group(arithmetic);

  const std::string machine = "Machine";
  app.add_option("--backend", o.renderer.backend, "auto, cpu, cuda [auto]")
      ->transform(tool::one_of<rgs::Backend>(
          {{"auto", rgs::Backend::automatic}, {"cpu", rgs::Backend::cpu}, {"cuda", rgs::Backend::cuda}}))
      ->group(machine);
  app.add_option("--devices", o.renderer.devices,
                 "N,... of GPUs by CUDA's numbers; each holds the scene and draws a part of the pictures")
      ->delimiter(',')
      ->allow_extra_args(false)
      ->group(machine);
  app.add_option("--threads", o.renderer.threads, "CPU threads, 0 for all cores")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str()
      ->group(machine);
  app.add_flag("--scalar", o.scalar, "the scalar definition on the CPU, pixel by pixel, instead of vectors")
      ->group(machine);
  tool::add_max_expansion(app, o.read.limits)->group(machine);
  tool::add_spz_axes(app, o.read.spz_axes);
  app.add_flag("--json", o.json, "summary as JSON on standard output")->group(machine);
  app.add_flag("--quiet,-q", o.quiet, "print no progress, summary or warnings")->group(machine);
  app.set_version_flag("--version", "rgs-render " RGS_VERSION);
  app.footer(
      "Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input, 6 a picture is coarser than "
      "asked for: pages of a file with levels of detail are missing, or --realtime had no time for them.");
}

// A contradiction among options; empty if there is none.
std::string contradiction(const Options& o) {
  if (!o.size.empty() && !tool::parse_size(o.size)) return "--size takes WxH, sides 1 to 65536, not '" + o.size + "'";
  if ((!o.view.empty() || !o.split.empty()) && (o.cameras.empty() || o.orbit > 0 || !o.path.empty()))
    return "--view and --split choose among the pictures of --cameras";
  if (!o.cameras.empty() && !o.path.empty()) return "--cameras and --path exclude each other";
  if (o.alpha && (names_picture(o.out) ? *rgs::image_format(o.out) == rgs::ImageFormat::jpeg : o.format == "jpg"))
    return "JPEG has no alpha: choose .png, .tif or .exr";
  if (const auto depth = rgs::image_format(o.depth);
      depth && (*depth == rgs::ImageFormat::png || *depth == rgs::ImageFormat::jpeg))
    return "depth needs floating point: name the file .exr or .tif";
  if (o.host_memory == std::uint64_t{0}) return "--host-memory must be more than 0 bytes";
  if (o.device_memory == std::uint64_t{0}) return "--device-memory must be more than 0 bytes";
  if (!o.renderer.devices.empty() && is_streamed(o))
    return "a streamed scene is drawn on one device: leave out --devices, or name a file and no --device-memory";
  if ((o.wait || o.realtime) && !is_streamed(o))
    return "--wait and --realtime need a streamed scene: give --host-memory, --device-memory, or an address";
  for (const float v : o.render.background)
    if (!std::isfinite(v)) return "--background takes three finite numbers";
  return {};
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options options;
    CLI::App app{"Renders a 3D Gaussian splat scene to pictures.", "rgs-render"};
    add_options(app, options);
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    options.renderer.simd = !options.scalar;
    for (const auto* option : app.get_option("--mode")->get_excludes()) options.has_arithmetic |= option->count() > 0;
    if (const std::string wrong = contradiction(options); !wrong.empty()) return tool::report_usage(wrong);
    return is_streamed(options) ? render_streamed(options) : render(options);
  });
}
