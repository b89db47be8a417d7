// rgs_bench_opening.cpp - rgs-bench-opening: from an .rgs file on disk to the first picture in host memory, in steps.
// SPDX-License-Identifier: Apache-2.0
#include <cuda_runtime_api.h>
#include <fcntl.h>
#include <fmt/chrono.h>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "bench_run.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "rgs/camera.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/cuda_renderer.hpp"
#include "rgs/file.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/version.hpp"

namespace {

namespace tool = rgs::tool;
using rgs::Result;
using Clock = std::chrono::steady_clock;

struct Options {
  std::vector<std::string> files, decode{"device", "host"};
  std::string cameras, size = "1920x1080", json;
  int runs = 9;
  bool is_cold = false, overwrite = false;
  rgs::DecodeLimits limits;
};

/// Steps of one opening, one after the other, ms.
struct Steps {
  double open = 0;    ///< file mapped, header read and checked
  double setup = 0;   ///< memory, streams
  double host = 0;    ///< read, decompressed, on its way to the device
  double device = 0;  ///< the rest of copying, decoding and checking
  double frame = 0;   ///< drawn and in host memory
  double total = 0;
};
constexpr std::array kSteps = {std::pair("open_ms", &Steps::open),   std::pair("setup_ms", &Steps::setup),
                               std::pair("host_ms", &Steps::host),   std::pair("device_ms", &Steps::device),
                               std::pair("frame_ms", &Steps::frame), std::pair("total_ms", &Steps::total)};

/// A picture on the device and on the host.
class Picture {
 public:
  explicit Picture(tool::ImageSize size)
      : host_(3 * static_cast<std::size_t>(size.width) * static_cast<std::size_t>(size.height)) {
    if (cudaMalloc(reinterpret_cast<void**>(&device_), host_.size() * sizeof(float)) != cudaSuccess) device_ = nullptr;
  }
  Picture(const Picture&) = delete;
  Picture& operator=(const Picture&) = delete;
  ~Picture() { cudaFree(device_); }

  bool is_there() const { return device_ != nullptr; }
  rgs::DeviceTarget target() const { return {.rgb = device_}; }
  rgs::Status download() {
    if (cudaMemcpy(host_.data(), device_, host_.size() * sizeof(float), cudaMemcpyDeviceToHost) == cudaSuccess)
      return {};
    return rgs::make_error(rgs::Errc::device_failed, rgs::Error::kNone, "a frame could not be copied from the device");
  }

 private:
  float* device_ = nullptr;
  std::vector<float> host_;
};

// The measurement's set-up.
struct Bench {
  const Options& options;
  tool::ImageSize size;
  std::optional<rgs::Camera> camera;  // absent: each file's default view
  rgs::CudaRenderer renderer;
  Picture picture;
};

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

// Drops the file from the page cache, if the system follows the advice.
rgs::Status forget(const std::string& path) {
  const int fd = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (fd < 0) return rgs::make_error(rgs::Errc::open_failed, rgs::Error::kNone, "cannot be opened");
  posix_fadvise(fd, 0, 0, POSIX_FADV_DONTNEED);
  close(fd);
  return {};
}

// A file's header, with or without levels of detail.
struct Head {
  std::optional<rgs::PagedFile> levels;
  rgs::FileView view;  // without levels

  static Result<Head> open(std::span<const std::byte> bytes, const rgs::DecodeLimits& limits) {
    Head head;
    if (rgs::has_levels(bytes)) {
      auto levels = rgs::PagedFile::open(bytes, limits);
      if (!levels) return tl::unexpected(levels.error());
      head.levels = *std::move(levels);
      return head;
    }
    auto view = rgs::FileView::open(bytes, limits);
    if (!view) return tl::unexpected(view.error());
    head.view = *std::move(view);
    return head;
  }
  const rgs::FileView& file() const { return levels ? levels->head() : view; }
  const char* profile() const {
    if (file().archive() != nullptr) return "archive";
    return (levels ? levels->codec() != rgs::Codec::none : view.coded()) ? "packed" : "direct";
  }
  Result<rgs::DeviceScene> upload(const rgs::UploadOptions& options) const {
    return levels ? rgs::DeviceScene::upload(*levels, options) : rgs::DeviceScene::upload(view, options);
  }
};

Result<Steps> open_once(Bench& bench, const std::string& path, bool decode_on_host) {
  if (bench.options.is_cold) {
    if (const auto ok = forget(path); !ok) return tl::unexpected(ok.error());
  }
  Steps steps;
  const auto start = Clock::now();
  const auto file = rgs::MappedFile::open(path);
  if (!file) return tl::unexpected(file.error());
  const auto head = Head::open(file->bytes(), bench.options.limits);
  if (!head) return tl::unexpected(head.error());
  steps.open = ms_since(start);
  rgs::UploadTimes times;
  const auto scene = head->upload({.decode_on_host = decode_on_host, .times = &times});
  if (!scene) return tl::unexpected(scene.error());
  steps.setup = times.setup_ms, steps.host = times.host_ms, steps.device = times.device_ms;
  const auto uploaded = Clock::now();
  const rgs::Declarations& declared = head->file().declarations();
  const rgs::Camera camera =
      bench.camera ? *bench.camera
                   : rgs::default_view(rgs::declared_bounds(declared), {bench.size.width, bench.size.height, 60},
                                       rgs::declared_up(declared));
  rgs::RenderOptions how;
  how.pipeline = rgs::Pipeline::turbo;
  const auto stats = bench.renderer.render(*scene, camera, bench.picture.target(), how);
  if (!stats) return tl::unexpected(stats.error());
  if (const auto ok = bench.picture.download(); !ok) return tl::unexpected(ok.error());
  steps.frame = ms_since(uploaded);
  steps.total = ms_since(start);
  return steps;
}

// Each step's median.
Steps median(std::span<const Steps> runs) {
  Steps result;
  for (const auto& [name, step] : kSteps) {
    std::vector<double> values;
    for (const Steps& run : runs) values.push_back(run.*step);
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    result.*step = *middle;
  }
  return result;
}

nlohmann::ordered_json measured_json(std::span<const Steps> runs, std::uint64_t file_bytes) {
  nlohmann::ordered_json json;
  const Steps middle = median(runs);
  for (const auto& [name, step] : kSteps) json[name] = middle.*step;
  json["file_bytes_per_second"] = static_cast<double>(file_bytes) / (middle.total * 1e-3);
  for (const Steps& run : runs) json["runs_total_ms"].push_back(run.total);
  return json;
}

// Rows of the table as they come; the file's element of the report.
tl::expected<nlohmann::ordered_json, int> measure_file(Bench& bench, const std::string& path,
                                                       void (*print)(std::string_view)) {
  nlohmann::ordered_json json;
  {
    const auto file = rgs::MappedFile::open(path);
    if (!file) return tl::unexpected<int>(tool::report(path, file.error()));
    const auto head = Head::open(file->bytes(), bench.options.limits);
    if (!head) return tl::unexpected<int>(tool::report(path, head.error()));
    json = {{"name", std::filesystem::path(path).filename().string()},
            {"bytes", file->bytes().size()},
            {"profile", head->profile()},
            {"gaussians", head->file().header().n_gaussians},
            {"sh_degree", head->file().header().sh_degree}};
  }
  const auto name = tool::printable(json["name"].get<std::string>());
  for (const std::string& decode : bench.options.decode) {
    std::vector<Steps> runs;
    for (int run = -1; run < bench.options.runs; ++run) {  // the first loads kernels and grows the workspace
      const auto steps = open_once(bench, path, decode == "host");
      if (!steps) return tl::unexpected<int>(tool::report(path, steps.error()));
      if (run >= 0) runs.push_back(*steps);
    }
    json[decode] = measured_json(runs, json["bytes"].get<std::uint64_t>());
    const Steps m = median(runs);
    print(fmt::format("{:<28} {:<8} {:<6} {:>8.2f} {:>8.2f} {:>8.2f} {:>8.2f} {:>8.2f} {:>9.2f}\n", name,
                      json["profile"].get<std::string>(), decode, m.open, m.setup, m.host, m.device, m.frame, m.total));
    tool::flush();
  }
  return json;
}

int bench_opening(const Options& o) {
  const auto size = tool::parse_size(o.size);
  if (!size) return tool::report_usage("--size takes WxH, not '" + o.size + "'");
  tool::InputFiles inputs;
  for (const std::string& path : o.files) inputs.add(path);
  inputs.add_cameras(o.cameras);
  const std::array output_paths{o.json};
  if (const int code = inputs.check_outputs(output_paths); code != tool::kSuccess) return code;
  std::optional<rgs::AtomicFile> output;
  if (!o.json.empty()) {
    auto file = rgs::AtomicFile::create(o.json, {.overwrite = o.overwrite, .sync = true});
    if (!file) return tool::report(o.json, file.error());
    output = std::move(*file);
  }
  const auto device = rgs::bench::device_info();
  if (!device) return tool::report("", device.error());
  auto renderer = rgs::CudaRenderer::create();
  if (!renderer) return tool::report("", renderer.error());
  Bench bench{o, *size, std::nullopt, std::move(*renderer), Picture(*size)};
  if (!bench.picture.is_there()) {
    return tool::report(
        "", rgs::Error{.code = rgs::Errc::device_out_of_memory, .what = "the device has no memory for a picture"});
  }
  if (!o.cameras.empty()) {
    const auto cameras = rgs::read_cameras(o.cameras);
    if (!cameras) return tool::report(o.cameras, cameras.error());
    bench.camera = rgs::resized(cameras->front(), size->width, size->height);
  }
  const auto now = fmt::gmtime(std::chrono::system_clock::to_time_t(std::chrono::system_clock::now()));
  nlohmann::ordered_json report{{"schema", "rgs-bench-opening/1"},
                                {"version", RGS_VERSION},
                                {"date", fmt::format("{:%Y-%m-%dT%H:%M:%SZ}", now)},
                                {"device", device->name},
                                {"width", size->width},
                                {"height", size->height},
                                {"runs", o.runs},
                                {"cold", o.is_cold},
                                {"files", nlohmann::ordered_json::array()}};
  // A report on standard output stays parseable.
  void (*const print)(std::string_view) = o.json == "-" ? tool::print_error : tool::print;
  print(fmt::format("{}, {} {} runs\n{:<28} {:<8} {:<6} {:>8} {:>8} {:>8} {:>8} {:>8} {:>9}\n", device->name, o.runs,
                    o.is_cold ? "cold" : "warm", "ms", "profile", "decode", "open", "setup", "host", "device", "frame",
                    "total"));
  for (const std::string& path : o.files) {
    auto measured = measure_file(bench, path, print);
    if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
    if (!measured) return measured.error();
    report["files"].push_back(*std::move(measured));
  }
  if (!output) return tool::kSuccess;
  const std::string text = report.dump(1, ' ', true, nlohmann::json::error_handler_t::replace) + "\n";
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
    CLI::App app{"Measures the time from an .rgs file to its first picture on the GPU, step by step.",
                 "rgs-bench-opening"};
    app.set_version_flag("--version", "rgs-bench-opening " RGS_VERSION);
    app.add_option("FILE", o.files, ".rgs files")->required();
    tool::add_max_expansion(app, o.limits);
    app.add_option("--cameras,-c", o.cameras,
                   "draw the first of these cameras (docs/user/CAMERAS.md) [a view of the whole scene]");
    app.add_option("--size", o.size, "WxH of the picture")->capture_default_str();
    app.add_option("--runs", o.runs, "measured openings, after one warm-up")
        ->check(CLI::Range(1, 10000))
        ->capture_default_str();
    app.add_option("--decode", o.decode, "where coded files are decoded: device, or host and then copied")
        ->delimiter(',')
        ->check(CLI::IsMember({"device", "host"}))
        ->capture_default_str();
    app.add_flag("--cold", o.is_cold, "drop the file from the page cache before each run");
    app.add_option("--json", o.json, "write all of it as JSON (docs/user/BENCH_JSON.md); - is standard output");
    app.add_flag("--overwrite", o.overwrite, "replace an existing output");
    app.footer("Exit codes: 0 done, 1 internal, 2 usage, 3 input/output or device, 4 malformed input.");
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    return bench_opening(o);
  });
}
