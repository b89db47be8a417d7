// rgs_bench_flight.cpp - rgs-bench-flight: flies through a streamed scene at a steady rate, and jumps: times, bytes, and how far the pictures are
// from complete ones.
// SPDX-License-Identifier: Apache-2.0
#ifdef RGS_BENCH_CUDA
#include <cuda_runtime_api.h>
#endif
#include <fcntl.h>
#include <fmt/chrono.h>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "rgs/byte_source.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "rgs/image_metrics.hpp"
#include "rgs/renderer.hpp"
#include "rgs/scene.hpp"
#include "rgs/version.hpp"
#ifdef RGS_STREAM_TIMES
#include "stream/stream_times.hpp"
#endif

namespace {

namespace tool = rgs::tool;
using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;
using rgs::Result;

struct Options {
  std::string scene, path, size = "3840x2160", json, pictures;
  int frames = 600, compare = 0, teleport = 0;
  double fps = 60, wait = 60;
  std::uint64_t host_memory = std::uint64_t{2} << 30;
  std::optional<std::uint64_t> device_memory;
  bool is_cold = false, overwrite = false;
  rgs::RenderOptions render;
};

// When a picture counts as arrived, dB against the complete one.
constexpr double kGoodDb = 35, kVeryGoodDb = 40;

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

// An address without user, password, query and fragment.
std::string shown_name(const std::string& scene) {
  if (!rgs::is_url(scene)) return std::filesystem::path(scene).filename().string();
  const std::string path = scene.substr(0, scene.find_first_of("?#"));
  return path.substr(path.rfind('/') + 1);
}

// Drops the file from the page cache, if the system follows the advice.
rgs::Status forget(const std::string& path) {
  const int fd = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (fd < 0) return rgs::make_error(rgs::Errc::open_failed, rgs::Error::kNone, "cannot be opened");
  posix_fadvise(fd, 0, 0, POSIX_FADV_DONTNEED);
  close(fd);
  return {};
}

// Device memory used by all programs; absent without a device.
std::optional<std::uint64_t> driver_bytes() {
#ifdef RGS_BENCH_CUDA
  std::size_t free = 0, total = 0;
  if (cudaMemGetInfo(&free, &total) == cudaSuccess) return total - free;
  cudaGetLastError();
#endif
  return std::nullopt;
}

// The quantile `share`; 0 for none.
double quantile(std::vector<double> values, double share) {
  if (values.empty()) return 0;
  std::ranges::sort(values);
  const auto at = static_cast<std::size_t>(share * static_cast<double>(values.size() - 1) + 0.5);
  return values[at];
}

// A picture allocated before it is drawn, page-locked where a device draws: a copy then takes as long as the bus, and no page
// faults.
class Picture {
 public:
  explicit Picture(const rgs::Camera& camera) : image_(rgs::Image::make(camera.width, camera.height, 3)) {
#ifdef RGS_BENCH_CUDA
    const std::span<float> all(image_.pixels);
    if (cudaHostRegister(all.data(), all.size_bytes(), cudaHostRegisterDefault) == cudaSuccess) {
      locked_.reset(all.data());
    } else {
      cudaGetLastError();  // slower, and no less right
    }
#endif
  }
  rgs::Image& image() {
    return image_;
  }
  const rgs::Image& image() const {
    return image_;
  }

 private:
  rgs::Image image_;
#ifdef RGS_BENCH_CUDA
  struct Unlock {
    void operator()(float* pixels) const { cudaHostUnregister(pixels); }
  };
  std::unique_ptr<float, Unlock> locked_;  // goes before the pixels
#endif
};

// Pictures are allocated ahead and reused.
class Pictures {
 public:
  void stock(std::size_t n, const rgs::Camera& camera) {
    while (free_.size() < n) free_.emplace_back(camera);
  }
  bool empty() const { return free_.empty(); }
  Picture take() {
    Picture last = std::move(free_.back());
    free_.pop_back();
    return last;
  }
  void give(Picture picture) { free_.push_back(std::move(picture)); }

 private:
  std::vector<Picture> free_;
};

// Kept of one arrival, at most.
constexpr std::size_t kKeptPictures = 48;

// Binary PPM, which needs no library.
rgs::Status write_ppm(const std::string& path, const rgs::Image& image, bool overwrite) {
  auto file = rgs::AtomicFile::create(path, {.overwrite = overwrite, .sync = false});
  if (!file) return tl::unexpected(file.error());
  const std::string head = fmt::format("P6\n{} {}\n255\n", image.width, image.height);
  std::vector<std::uint8_t> codes(image.pixels.size());
  std::ranges::transform(image.pixels, codes.begin(), rgs::to_8bit);
  rgs::Status written = file->write_at(0, std::as_bytes(std::span(head)));
  if (written) written = file->write_at(head.size(), std::as_bytes(std::span(codes)));
  if (!written) return written;
  const auto committed = file->commit();
  return committed ? rgs::Status() : tl::unexpected(committed.error());
}

// The measurement's set-up.
struct Bench {
  const Options& options;
  rgs::Renderer renderer;
  std::vector<rgs::Camera> cameras;
  Pictures pictures = {};
  std::optional<Picture> shown = {};  ///< target of frames that are not compared

  Result<rgs::Scene> open(const rgs::StreamPool& pool) const {
    rgs::UrlOptions way;
    if (options.wait > 0) way.open_seconds = std::min(options.wait, 86400.);
    return rgs::Scene::open(options.scene, {.pool = pool, .url = way});
  }
  Result<rgs::StreamPool> pool() const {
    return rgs::StreamPool::create(
        {.host_memory = options.host_memory, .device_memory = options.device_memory.value_or(0)});
  }
  rgs::Status forget_file() const { return options.is_cold ? forget(options.scene) : rgs::Status(); }
  /// A frame of the resident pages.
  Result<rgs::FrameStats> draw(const rgs::Scene& scene, const rgs::Camera& camera, Picture* picture) {
    rgs::RenderTarget target;
    target.rgb = (picture != nullptr ? *picture : *shown).image().pixels;
    return renderer.render(scene, camera, target, options.render);
  }
};

// The complete picture of a view; absent if it is not complete in time.
Result<std::optional<Picture>> complete_picture(Bench& bench, const rgs::Scene& scene, const rgs::Camera& camera) {
  const auto refined = bench.renderer.refine(scene, camera, bench.options.wait, bench.options.render);
  if (!refined) return tl::unexpected(refined.error());
  if (!*refined) return std::nullopt;
  Picture picture(camera);
  if (const auto drawn = bench.draw(scene, camera, &picture); !drawn) return tl::unexpected(drawn.error());
  return picture;
}

// Infinite for equal pictures.
Result<double> psnr(const rgs::Image& a, const rgs::Image& b) {
  const auto far = rgs::difference(a, b);
  if (!far) return tl::unexpected(far.error());
  return far->psnr;
}

// JSON has no infinity: null means equal pictures.
Json db_json(double db) {
  return std::isfinite(db) ? Json(db) : Json(nullptr);
}
Json optional_json(const std::optional<double>& value) {
  return value ? Json(*value) : Json(nullptr);
}

// Time of threads and frames of streamed scenes, summed; empty in builds without RGS_STREAM_TIMES.
struct Steps {
#ifdef RGS_STREAM_TIMES
  std::array<std::uint64_t, rgs::detail::kStreamSteps> ns{}, n{};

  static Steps now() {
    Steps steps;
    for (std::size_t k = 0; k < steps.n.size(); ++k) {
      steps.ns[k] = rgs::detail::stream_totals[k].ns;
      steps.n[k] = rgs::detail::stream_totals[k].n;
    }
    return steps;
  }
  Json json_since(const Steps& before) const {
    Json json;
    for (std::size_t k = 0; k < n.size(); ++k) {
      json[rgs::detail::kStreamStepNames[k]] = {{"ms", 1e-6 * static_cast<double>(ns[k] - before.ns[k])},
                                                {"n", n[k] - before.n[k]}};
    }
    return json;
  }
#else
  static Steps now() {
    return {};
  }
  Json json_since(const Steps&) const {
    return nullptr;
  }
#endif
};

// From asking for a view until 35 dB, 40 dB and complete; ms.
struct Arrival {
  /// After a frame.
  struct Progress {
    double ms;
    std::uint64_t bytes_decoded, pages_missing;
  };

  double first_ms = 0, first_detail_px = 0;
  std::optional<double> first_db;
  std::uint64_t first_bytes_read = 0, bytes_read = 0, bytes_decoded = 0;
  std::vector<Progress> progress;
  Json steps;
  std::optional<double> good_ms, very_good_ms, complete_ms;

  Json json() const {
    Json frames = Json::array();
    for (const Progress& p : progress) frames.push_back({p.ms, p.bytes_decoded, p.pages_missing});
    Json json{{"first_ms", first_ms},
              {"first_bytes_read", first_bytes_read},
              {"first_detail_px", first_detail_px},
              {"first_psnr", first_db ? db_json(*first_db) : Json(nullptr)},
              {"ms_to_35_db", optional_json(good_ms)},
              {"ms_to_40_db", optional_json(very_good_ms)},
              {"ms_to_complete", optional_json(complete_ms)},
              {"bytes_read", bytes_read},
              {"bytes_decoded", bytes_decoded},
              {"progress", std::move(frames)}};
    if (!steps.is_null()) json["steps"] = steps;
    return json;
  }
};

// Draws until nothing is missing and keeps some pictures, fewer and fewer, to compare with the last one. Needs a stock in
// Bench::pictures. `before`: the scene's counts at `start`.
Result<Arrival> arrive(Bench& bench, const rgs::Scene& scene, const rgs::Camera& camera, Clock::time_point start,
                       const rgs::StreamStats& before) {
  struct Kept {
    double ms;
    Picture picture;
  };
  std::vector<Kept> kept;
  Arrival arrival;
  const Steps steps_before = Steps::now();
  for (double next_ms = 0;;) {
    std::optional<Picture> picture;
    if (!bench.pictures.empty() && ms_since(start) >= next_ms) picture = bench.pictures.take();
    const auto stats = bench.draw(scene, camera, picture ? &*picture : nullptr);
    if (!stats) return tl::unexpected(stats.error());
    const double ms = ms_since(start);
    if (kept.empty()) {
      arrival.first_ms = ms;
      arrival.first_detail_px = stats->stream.detail_reached_px;
      arrival.first_bytes_read = stats->stream.bytes_read - before.bytes_read;
    }
    arrival.bytes_decoded = stats->stream.bytes_decoded - before.bytes_decoded;
    arrival.progress.push_back({ms, arrival.bytes_decoded, stats->stream.pages_missing});
    if (picture) {
      kept.push_back({ms, *std::move(picture)});
      next_ms = 1.15 * ms;
    }
    if (stats->stream.pages_missing == 0) arrival.complete_ms = ms;
    if (arrival.complete_ms || ms > 1e3 * bench.options.wait) break;
  }
  arrival.steps = Steps::now().json_since(steps_before);
  const auto complete = complete_picture(bench, scene, camera);
  if (!complete) return tl::unexpected(complete.error());
  arrival.bytes_read = scene.stats().bytes_read - before.bytes_read;
  for (Kept& each : kept) {
    if (!*complete) break;
    const auto db = psnr(each.picture.image(), (*complete)->image());
    if (!db) return tl::unexpected(db.error());
    if (&each == &kept.front()) arrival.first_db = *db;
    if (!arrival.good_ms && *db >= kGoodDb) arrival.good_ms = each.ms;
    if (!arrival.very_good_ms && *db >= kVeryGoodDb) arrival.very_good_ms = each.ms;
  }
  for (Kept& each : kept) bench.pictures.give(std::move(each.picture));
  for (auto* const reached : {&arrival.good_ms, &arrival.very_good_ms}) {
    if (!*reached) *reached = arrival.complete_ms;
  }
  return arrival;
}

// Views far apart on the path, n of them, each once before any repeats.
std::size_t jump(int k, std::size_t n) {
  constexpr double kGolden = 0.6180339887498949;
  std::vector<bool> was(n);
  std::size_t at = 0;
  for (int i = 0; i <= k; ++i) {
    if (i % static_cast<int>(n) == 0) was.assign(n, false);
    at = static_cast<std::size_t>(std::fmod((i + 1) * kGolden, 1.0) * static_cast<double>(n));
    while (was[at]) at = (at + 1) % n;
    was[at] = true;
  }
  return at;
}

struct Frame {
  double render_ms, wall_ms, due_ms, begin_ms;
  rgs::FrameStats stats;
  bool is_late;  ///< the next one was due before it began: nothing new was shown for one frame
};

Json frame_json(const Frame& f) {
  const rgs::StreamStats& s = f.stats.stream;
  return {{"render_ms", f.render_ms},
          {"wall_ms", f.wall_ms},
          {"due_ms", f.due_ms},
          {"begin_ms", f.begin_ms},
          {"pages", f.stats.pages},
          {"gaussians", f.stats.gaussians},
          {"pages_missing", s.pages_missing},
          {"detail_reached_px", s.detail_reached_px},
          {"bytes_read", s.bytes_read},
          {"bytes_decoded", s.bytes_decoded},
          {"bytes_uploaded", s.bytes_uploaded},
          {"bytes_evicted", s.bytes_evicted},
          {"workspace_bytes", f.stats.bytes}};
}

using Print = void (*)(std::string_view);

// The flight in real time, with some pictures compared with complete ones.
Result<Json> fly(Bench& bench, const rgs::Scene& scene, Print print) {
  const Options& o = bench.options;
  std::vector<Frame> frames;
  std::vector<std::pair<std::size_t, Picture>> kept;
  if (o.compare > 0) {
    const auto each = static_cast<std::size_t>(o.compare);
    bench.pictures.stock((bench.cameras.size() + each - 1) / each, bench.cameras.front());
  }
  const rgs::StreamStats before = scene.stats();
  const auto start = Clock::now();
  for (std::size_t i = 0; i < bench.cameras.size(); ++i) {
    const double due_ms = 1e3 * static_cast<double>(i) / o.fps;
    std::this_thread::sleep_until(
        start + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double, std::milli>(due_ms)));
    const double begin_ms = ms_since(start);
    const bool is_kept = o.compare > 0 && i % static_cast<std::size_t>(o.compare) == 0;
    std::optional<Picture> picture;
    if (is_kept) picture = bench.pictures.take();
    const auto stats = bench.draw(scene, bench.cameras[i], picture ? &*picture : nullptr);
    if (!stats) return tl::unexpected(stats.error());
    frames.push_back(
        {stats->total_ms, ms_since(start) - begin_ms, due_ms, begin_ms, *stats, begin_ms > due_ms + 1e3 / o.fps});
    if (picture) kept.emplace_back(i, *std::move(picture));
  }
  const double seconds = 1e-3 * ms_since(start);
  const rgs::StreamStats after = scene.stats();
  std::vector<double> render_ms, detail_px;
  std::size_t n_late = 0;
  std::uint64_t workspace = 0;
  Json list = Json::array();
  for (const Frame& f : frames) {
    render_ms.push_back(f.render_ms), detail_px.push_back(f.stats.stream.detail_reached_px);
    n_late += f.is_late;
    workspace = std::max(workspace, f.stats.bytes);
    list.push_back(frame_json(f));
  }
  const auto rate = [&](std::uint64_t from, std::uint64_t to) { return static_cast<double>(to - from) / seconds; };
  Json flight{{"frames_drawn", frames.size()},
              {"seconds", seconds},
              {"render_ms_median", quantile(render_ms, 0.5)},
              {"render_ms_p99", quantile(render_ms, 0.99)},
              {"frames_late", n_late},
              {"detail_px_median", quantile(detail_px, 0.5)},
              {"detail_px_largest", quantile(detail_px, 1)},
              {"read_bytes_per_second", rate(before.bytes_read, after.bytes_read)},
              {"decoded_bytes_per_second", rate(before.bytes_decoded, after.bytes_decoded)},
              {"uploaded_bytes_per_second", rate(before.bytes_uploaded, after.bytes_uploaded)},
              {"evicted_bytes_per_second", rate(before.bytes_evicted, after.bytes_evicted)},
              {"workspace_bytes", workspace}};
  print(fmt::format("flight    {} frames, {:g} a second: {:.3f} ms each, {:.3f} for 99 of 100; {} late\n",
                    frames.size(), o.fps, quantile(render_ms, 0.5), quantile(render_ms, 0.99), n_late));
  print(fmt::format("          error drawn {:.3g} px, at most {:.3g}; read {} a second, decoded {}\n",
                    quantile(detail_px, 0.5), quantile(detail_px, 1),
                    tool::format_bytes(static_cast<std::uint64_t>(rate(before.bytes_read, after.bytes_read))),
                    tool::format_bytes(static_cast<std::uint64_t>(rate(before.bytes_decoded, after.bytes_decoded)))));
  if (o.compare > 0) {
    std::vector<double> finite;
    double worst = INFINITY, squares = 0;
    std::size_t n_compared = 0;
    Json each = Json::array();
    for (auto& [i, picture] : kept) {
      if (!o.pictures.empty()) {
        const std::string path = (std::filesystem::path(o.pictures) / fmt::format("frame_{:04}.ppm", i)).string();
        if (const auto ok = write_ppm(path, picture.image(), o.overwrite); !ok) return tl::unexpected(ok.error());
      }
      const auto complete = complete_picture(bench, scene, bench.cameras[i]);
      if (!complete) return tl::unexpected(complete.error());
      if (!*complete) continue;
      const auto db = psnr(picture.image(), (*complete)->image());
      if (!db) return tl::unexpected(db.error());
      ++n_compared;
      worst = std::min(worst, *db);
      squares += std::pow(10, -*db / 10);
      if (std::isfinite(*db)) finite.push_back(*db);
      each.push_back({{"frame", i}, {"psnr", db_json(*db)}});
    }
    double mean = INFINITY;  // of all that differ
    if (!finite.empty()) {
      mean = 0;
      for (const double db : finite) mean += db / static_cast<double>(finite.size());
    }
    flight["compared"] = {
        {"pictures", n_compared},
        {"incomplete", kept.size() - n_compared},
        {"equal", n_compared - finite.size()},
        {"psnr_mean", db_json(mean)},
        {"psnr_of_mean_error",
         n_compared == 0 ? Json(nullptr) : db_json(-10 * std::log10(squares / static_cast<double>(n_compared)))},
        {"psnr_worst", db_json(worst)},
        {"each", std::move(each)}};
    const std::string others = finite.empty() ? "" : fmt::format(", the others {:.2f} dB, worst {:.2f}", mean, worst);
    print(fmt::format("pictures  {} compared with complete ones: {} equal{}; {} not complete in time\n", n_compared,
                      n_compared - finite.size(), others, kept.size() - n_compared));
  }
  flight["frames"] = std::move(list);
  return flight;
}

std::string shown_ms(const std::optional<double>& ms) {
  return ms ? fmt::format("{:.1f}", *ms) : "-";
}
void print_arrival(const std::string& what, const Arrival& a, Print print) {
  const std::string db = a.first_db ? fmt::format(", {:.2f} dB", *a.first_db) : "";
  print(fmt::format("{:<9} first picture {:.1f} ms, {} read{}; ms to 35 dB {}, to 40 dB {}, complete {}\n", what,
                    a.first_ms, tool::format_bytes(a.first_bytes_read), db, shown_ms(a.good_ms),
                    shown_ms(a.very_good_ms), shown_ms(a.complete_ms)));
  if (a.steps.is_null()) return;
  std::string steps;
  for (const auto& [name, step] : a.steps.items()) {
    steps += fmt::format(" {} {:.1f} ({}),", name, step["ms"].get<double>(), step["n"].get<std::uint64_t>());
  }
  if (!steps.empty()) steps.pop_back();
  print(fmt::format("          {} frames, {} decoded; ms of all threads (times):{}\n", a.progress.size(),
                    tool::format_bytes(a.bytes_decoded), steps));
}

// Jumps in a scene that has shown only the first view.
Result<Json> teleport(Bench& bench, Print print) {
  const auto pool = bench.pool();
  if (!pool) return tl::unexpected(pool.error());
  const auto scene = bench.open(*pool);
  if (!scene) return tl::unexpected(scene.error());
  if (const auto first = complete_picture(bench, *scene, bench.cameras.front()); !first)
    return tl::unexpected(first.error());
  Json jumps = Json::array();
  for (int k = 0; k < bench.options.teleport; ++k) {
    const std::size_t at = jump(k, bench.cameras.size());
    if (const auto ok = bench.forget_file(); !ok) return tl::unexpected(ok.error());
    const auto arrival = arrive(bench, *scene, bench.cameras[at], Clock::now(), scene->stats());
    if (!arrival) return tl::unexpected(arrival.error());
    print_arrival(fmt::format("jump {}", k), *arrival, print);
    Json json = arrival->json();
    json["frame"] = at;
    jumps.push_back(std::move(json));
  }
  return jumps;
}

int bench_flight(const Options& o) {
  const auto size = tool::parse_size(o.size);
  if (!size) return tool::report_usage("--size takes WxH, not '" + o.size + "'");
  if (o.is_cold && rgs::is_url(o.scene)) return tool::report_usage("--cold needs a local file");
  if (o.device_memory == std::uint64_t{0} || o.host_memory == 0)
    return tool::report_usage("a memory budget must be more than 0 bytes");
  if (!o.pictures.empty() && o.compare == 0)
    return tool::report_usage("--pictures needs --compare: it writes the compared frames");
  tool::InputFiles inputs;
  if (!rgs::is_url(o.scene)) inputs.add_scene(o.scene);
  inputs.add_cameras(o.path);
  const std::array output_paths{o.json};
  if (const int code = inputs.check_outputs(output_paths); code != tool::kSuccess) return code;
  std::optional<rgs::AtomicFile> output;
  if (!o.json.empty()) {
    auto file = rgs::AtomicFile::create(o.json, {.overwrite = o.overwrite, .sync = true});
    if (!file) return tool::report(o.json, file.error());
    output = std::move(*file);
  }
  const auto keys = rgs::read_cameras(o.path);
  if (!keys) return tool::report(o.path, keys.error());
  auto renderer = rgs::Renderer::create({.backend = o.device_memory ? rgs::Backend::cuda : rgs::Backend::cpu});
  if (!renderer) return tool::report("", renderer.error());
  Bench bench{o, *std::move(renderer), rgs::interpolated_path(*keys, o.frames)};
  for (rgs::Camera& camera : bench.cameras) camera = rgs::resized(camera, size->width, size->height);
  // A report on standard output stays parseable.
  const Print print = o.json == "-" ? Print(tool::print_error) : Print(tool::print);
  const std::string name = shown_name(o.scene);
  const auto report = [&](const rgs::Error& error) { return tool::report(name, error); };

  bench.pictures.stock(kKeptPictures, bench.cameras.front());
  bench.shown.emplace(bench.cameras.front());
  if (const auto ok = bench.forget_file(); !ok) return report(ok.error());
  const auto start = Clock::now();
  const auto pool = bench.pool();
  if (!pool) return report(pool.error());
  auto opened = bench.open(*pool);
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!opened) return report(opened.error());
  std::optional<rgs::Scene> scene(*std::move(opened));
  const double open_ms = ms_since(start);
  const std::uint64_t open_bytes = scene->stats().bytes_read;
  print(fmt::format("{}: {} Gaussians, {} {}x{}\n", tool::printable(name), tool::format_count(scene->size()),
                    bench.renderer.backend_name(), size->width, size->height));
  const auto opening = arrive(bench, *scene, bench.cameras.front(), start, {});
  if (!opening) return report(opening.error());
  print_arrival("opening", *opening, print);
  auto flight = fly(bench, *scene, print);
  if (!flight) return report(flight.error());
  const auto now = fmt::gmtime(std::chrono::system_clock::to_time_t(std::chrono::system_clock::now()));
  Json json{{"schema", "rgs-bench-flight/1"},
            {"version", RGS_VERSION},
            {"date", fmt::format("{:%Y-%m-%dT%H:%M:%SZ}", now)},
            {"backend", bench.renderer.backend_name()},
            {"processors", std::thread::hardware_concurrency()},
            {"scene", {{"name", name}, {"gaussians", scene->size()}, {"sh_degree", scene->sh_degree()}}},
            {"width", size->width},
            {"height", size->height},
            {"fps", o.fps},
            {"detail_px", o.render.detail_px ? Json(*o.render.detail_px) : Json(nullptr)},
            {"cold", o.is_cold},
            {"host_memory", pool->host_memory()},
            {"device_memory", pool->device_memory()},
            {"host_bytes", pool->host_bytes()},
            {"device_bytes", pool->device_bytes()}};
  if (const auto used = driver_bytes()) json["driver_bytes"] = *used;
  json["opening"] = opening->json();
  json["opening"]["open_ms"] = open_ms;
  json["opening"]["open_bytes_read"] = open_bytes;
  json["flight"] = *std::move(flight);
  print(fmt::format("memory    {} of {}, on the device {} of {}\n", tool::format_bytes(pool->host_bytes()),
                    tool::format_bytes(pool->host_memory()), tool::format_bytes(pool->device_bytes()),
                    tool::format_bytes(pool->device_memory())));
  scene.reset();  // its memory of the device is the next one's
  if (o.teleport > 0) {
    auto jumps = teleport(bench, print);
    if (!jumps) return report(jumps.error());
    json["teleports"] = *std::move(jumps);
  }
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  if (!output) return tool::kSuccess;
  const std::string text = json.dump(1, ' ', true, Json::error_handler_t::replace) + "\n";
  rgs::Status written = output->write_at(0, std::as_bytes(std::span(text)));
  if (written) {
    const auto committed = output->commit();
    if (!committed) written = tl::unexpected(committed.error());
  }
  return written ? tool::kSuccess : tool::report(o.json, written.error());
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options o;
    CLI::App app{"Flies through a streamed scene at a steady rate and measures frames, bytes and pictures.",
                 "rgs-bench-flight"};
    app.set_version_flag("--version", "rgs-bench-flight " RGS_VERSION);
    app.add_option("FILE", o.scene, ".rgs file with levels of detail, or its http(s) address")->required();
    app.add_option("--path", o.path, "cameras to fly along (docs/user/CAMERAS.md)")->required();
    app.add_option("--frames", o.frames, "frames of the flight")
        ->check(CLI::Range(1, 1'000'000))
        ->capture_default_str();
    app.add_option("--size", o.size, "WxH of the pictures")->capture_default_str();
    app.add_option("--fps", o.fps, "frames a second")->check(CLI::Range(0.001, 1e4))->capture_default_str();
    app.add_option("--detail", o.render.detail_px, "projected error allowed, px [1]")->check(CLI::NonNegativeNumber);
    tool::add_bytes(app, "--host-memory", o.host_memory, "host memory budget [2GiB]");
    tool::add_bytes(app, "--device-memory", o.device_memory, "draw on the GPU with this budget [draw on the CPU]");
    app.add_option("--compare", o.compare, "also compare every Nth frame with the complete picture")
        ->check(CLI::Range(1, 1'000'000));
    app.add_option("--pictures", o.pictures, "folder for the compared frames: frame_NNNN.ppm");
    app.add_option("--teleport", o.teleport, "also jump to N views of the path in a newly opened scene")
        ->check(CLI::Range(1, 1'000'000));
    app.add_option("--wait", o.wait, "seconds to wait for a complete view")
        ->check(CLI::Range(0.0, 1e6))
        ->capture_default_str();
    app.add_flag("--cold", o.is_cold, "drop the file from the page cache before opening and before each jump");
    app.add_option("--json", o.json, "write all of it as JSON (docs/user/BENCH_JSON.md); - is standard output");
    app.add_flag("--overwrite", o.overwrite, "replace an existing output");
    app.footer("Exit codes: 0 done, 1 internal, 2 usage, 3 input/output or device, 4 malformed input.");
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    o.render.measure.stage_timings = false;  // events between the kernels cost time themselves
    return bench_flight(o);
  });
}
