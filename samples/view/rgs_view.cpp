// rgs_view.cpp - rgs-view: shows a scene, or compares two, on a page in the browser.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "browser.hpp"
#include "camera_choice.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "frame_maker.hpp"
#include "frame_request.hpp"
#include "http_server.hpp"
#include "input_files.hpp"
#include "max_expansion.hpp"
#include "page_export.hpp"
#include "photo_folder.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/version.hpp"
#include "sibling_program.hpp"
#include "spz_axes.hpp"
#include "view_documents.hpp"
#include "view_site.hpp"

namespace {

namespace fs = std::filesystem;
namespace tool = rgs::tool;
namespace view = rgs::view;

struct Options {
  std::string scene, other, cameras, photos, view;
  int port = 0;
  bool no_browser = false;
  rgs::Backend backend = rgs::Backend::automatic;  // automatic: no frames
  std::optional<std::uint64_t> host_memory, device_memory;
  int threads = 0;
  rgs::ReadOptions read;
  std::string export_to;
  std::uint64_t export_limit = std::uint64_t{256} << 20;
  bool overwrite = false;
};

bool has_frames(const Options& options) {
  return options.backend != rgs::Backend::automatic || options.host_memory || options.device_memory;
}

// Scenes, cameras and photographs, by their names on the page.
struct Shown {
  struct File {
    std::string name, path;
  };
  std::vector<std::string> scenes;  // paths
  std::vector<File> files;
  view::ViewDocument document;
  std::vector<rgs::Camera> cameras;
  std::string fragment;  // of the page's address: the first view
};

// What the page can read.
#define RGS_PAGE_FORMATS ".rgs, .ply, .compressed.ply, .spz or .sog"

bool is_shown(rgs::SplatFormat format, std::span<const std::byte> bytes) {
  switch (format) {
    case rgs::SplatFormat::rgs:
    case rgs::SplatFormat::ply:
    case rgs::SplatFormat::compressed_ply:
    case rgs::SplatFormat::spz: return true;
    case rgs::SplatFormat::sog: return bytes.front() == std::byte{'P'};  // zipped, not a meta.json beside its images
    default: return false;
  }
}

int add_scene(const std::string& path, Shown& shown) {
  const auto file = rgs::MappedFile::open(path);
  if (!file) return tool::report(path, file.error());
  const rgs::SplatFormat format = rgs::detect_format(file->bytes());
  if (format == rgs::SplatFormat::unknown) {
    rgs::Error error = rgs::read_splats(file->bytes()).error();  // says what it is, if that is known
    if (error.code == rgs::Errc::bad_magic) error.what = "is not a " RGS_PAGE_FORMATS " file";
    return tool::report(path, error);
  }
  if (!is_shown(format, file->bytes()))
    return tool::report(path, {rgs::Errc::unsupported_feature, rgs::Error::kNone,
                               "rgs-view shows only " RGS_PAGE_FORMATS "; rgs-convert makes .rgs of this"});
  const std::string folder = fmt::format("scenes/{}/", shown.document.scenes.size());
  const std::string name = fs::path(path).filename().string();
  shown.files.push_back({folder + name, path});
  shown.scenes.push_back(path);
  shown.document.scenes.push_back({name, folder + view::percent_encoded(name), file->bytes().size()});
  return tool::kSuccess;
}

int add_photos(const std::string& folder, Shown& shown) {
  const auto photos = rgs::PhotoFolder::open(folder);
  if (!photos) return tool::report(folder, photos.error());
  for (const rgs::Camera& camera : shown.cameras) {
    const std::string path = photos->find(camera.name);
    // Browsers cannot show TIFF and OpenEXR.
    if (path.empty() || std::string_view(view::content_type(path)).starts_with("application/")) continue;
    const std::string name =
        fmt::format("photos/{}{}", shown.document.photos.size(), fs::path(path).extension().string());
    shown.files.push_back({name, path});
    shown.document.photos.push_back({camera.name, name});
  }
  if (!shown.document.photos.empty()) return tool::kSuccess;
  return tool::report(folder,
                      {rgs::Errc::bad_argument, rgs::Error::kNone, "has no PNG or JPEG with the name of a camera"});
}

int look_at(const Options& options, Shown& shown) {
  shown.document.spz_opengl = options.read.spz_axes == rgs::kAxesOpenGl;
  for (const std::string* scene : {&options.scene, &options.other}) {
    if (scene->empty()) continue;
    if (const int code = add_scene(*scene, shown); code != tool::kSuccess) return code;
  }
  if (options.cameras.empty()) return tool::kSuccess;
  auto set = rgs::read_camera_set(options.cameras);
  if (!set) return tool::report(options.cameras, set.error());
  if (std::ranges::any_of(set->cameras, [](const rgs::Camera& c) { return c.model != rgs::CameraModel::pinhole; }))
    return tool::report(options.cameras, {rgs::Errc::unsupported_feature, rgs::Error::kNone,
                                          "the page draws pinhole cameras alone; rgs-render draws the others"});
  if (!options.view.empty()) {
    const auto chosen = rgs::choose_cameras(*set, "", options.view);
    if (!chosen) return tool::report_usage(chosen.error());
    if (chosen->size() != 1) return tool::report_usage("--view takes one camera");
    shown.fragment = "#" + view::view_link(chosen->front(), set->cameras, !options.other.empty());
  }
  shown.cameras = std::move(set->cameras);
  shown.document.cameras = "cameras.json";
  return options.photos.empty() ? tool::kSuccess : add_photos(options.photos, shown);
}

// The folder of the built page: named by the environment, beside the installed program, or in the source tree that holds
// build/PRESET.
rgs::Result<std::string> page_folder() {
  if (const char* named = std::getenv("RGS_VIEWER_DIR"); named != nullptr && *named != '\0') return std::string(named);
  std::vector<fs::path> places;
  if (const auto folder = tool::program_folder()) {
    const fs::path prefix = fs::path(*folder).parent_path(), above = prefix.parent_path();
    places.push_back(prefix / "share/roofgs/viewer");
    if (above.filename() == "build") places.push_back(above.parent_path() / "web/viewer/dist");
  }
  std::error_code ignored;
  for (const fs::path& place : places)
    if (fs::exists(place / "index.html", ignored)) return place.string();
  return rgs::make_error(
      rgs::Errc::open_failed, rgs::Error::kNone,
      "the viewer's page is not there; in the source tree of RoofGS type: sh scripts/build_page.sh; if the "
      "program is elsewhere: export RGS_VIEWER_DIR=SOURCE_TREE/web/viewer/dist");
}

// Ctrl-C ends the server with success. Signals are blocked in all threads but the one that waits for them here; those that were ignored
// (nohup) stay ignored.
void end_on_signals() {
  sigset_t ends;
  ::sigemptyset(&ends);
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) {
    struct sigaction action {};
    if (::sigaction(number, nullptr, &action) == 0 && action.sa_handler != SIG_IGN) ::sigaddset(&ends, number);
  }
  ::pthread_sigmask(SIG_BLOCK, &ends, nullptr);
  std::thread([ends] {
    int number = 0;
    ::sigwait(&ends, &number);
    tool::flush();
    ::_exit(tool::kSuccess);
  }).detach();
}

view::FrameSettings frame_settings(const Options& options) {
  view::FrameSettings settings{.backend = options.backend, .threads = options.threads, .read = options.read};
  // A scene is drawn where its pages are.
  if (settings.backend == rgs::Backend::automatic)
    settings.backend = options.device_memory ? rgs::Backend::cuda : rgs::Backend::cpu;
  if (options.host_memory || options.device_memory) {
    rgs::StreamPoolOptions budget;
    if (options.host_memory) budget.host_memory = *options.host_memory;
    if (options.device_memory) budget.device_memory = *options.device_memory;
    settings.budget = budget;
  }
  return settings;
}

// A page requests one frame at a time. More than these at once would keep all threads of the server waiting.
constexpr int kMostFramesAtOnce = 4;

view::HttpAnswer answer_frame(view::FrameMaker& frames, std::atomic<int>& n_at_once, const std::string& body) {
  const auto request = view::parse_frame_request(body, frames.n_scenes());
  if (!request) {
    view::HttpAnswer refusal = view::error_answer(request.error());
    refusal.status = 400;
    return refusal;
  }
  struct Count {
    std::atomic<int>& n;
    ~Count() { --n; }
  };
  const bool is_busy = ++n_at_once > kMostFramesAtOnce;
  const Count count{n_at_once};
  if (is_busy) {
    return {.status = 503,
            .fields = {{"Retry-After", "1"}},
            .type = "application/json",
            .body = view::error_body("busy", "the renderer is busy; ask again")};
  }
  auto frame = frames.make(*request);
  if (!frame) return view::error_answer(frame.error());
  view::HttpAnswer answer{.type = request->format == rgs::ImageFormat::jpeg ? "image/jpeg" : "image/png",
                          .body = std::move(frame->file)};
  answer.fields = {{"X-Render-Ms", fmt::format("{:.3f}", frame->render_ms)},
                   {"X-Encode-Ms", fmt::format("{:.3f}", frame->encode_ms)}};
  if (frame->stream) {
    answer.fields.emplace_back("X-Detail-Px", fmt::format("{:.6g}", frame->stream->detail_reached_px));
    answer.fields.emplace_back("X-Pages-Missing", std::to_string(frame->stream->pages_missing));
  }
  if (frame->stream_error) answer.fields.emplace_back("X-Scene-Error", tool::describe(*frame->stream_error));
  return answer;
}

int serve(const Options& options, Shown& shown) {
  end_on_signals();
  const auto folder = page_folder();
  if (!folder) return tool::report("", folder.error());
  auto token = view::random_token();
  if (!token) return tool::report("", token.error());
  auto server = view::HttpServer::listen(options.port);
  if (!server) return tool::report(fmt::format("127.0.0.1:{}", options.port), server.error());

  std::optional<view::FrameMaker> frames;
  std::atomic<int> n_frames_at_once{0};
  if (has_frames(options)) {
    auto made = view::FrameMaker::create(shown.scenes, frame_settings(options));
    if (!made) return tool::report(made.error().path, made.error().error);
    frames = *std::move(made);
    shown.document.backend = frames->backend() == rgs::Backend::cuda ? "cuda" : "cpu";
  }

  view::ViewSite site(*std::move(token), server->port());
  if (const rgs::Status added = site.add_page(*folder); !added) return tool::report(*folder, added.error());
  for (const Shown::File& file : shown.files)
    if (const rgs::Status added = site.add_file(file.name, file.path); !added)
      return tool::report(file.path, added.error());
  if (!shown.cameras.empty()) site.add_json("cameras.json", view::cameras_json(shown.cameras));
  if (frames) {
    site.add_action("frame", [&](const std::string& body) { return answer_frame(*frames, n_frames_at_once, body); });
  }
  site.add_json("view.json", view::view_json(shown.document));

  const std::string address = site.address() + shown.fragment;
  tool::print(address + "\n");
  tool::flush();
  if (!options.no_browser && view::has_screen() && !view::open_browser(address))
    tool::print_error("rgs-view: xdg-open does not start; open the address in a browser\n");
  server->serve(site.handlers());
  return tool::report("", {rgs::Errc::internal, rgs::Error::kNone, "the server ended by itself"});
}

// Writes one file; addresses in view.json become those of its elements.
int export_page(const Options& options, Shown& shown) {
  const auto folder = page_folder();
  if (!folder) return tool::report("", folder.error());
  // Beside the installed page, or in the source tree.
  std::error_code ignored;
  fs::path single = fs::path(*folder) / "single.html";
  if (!fs::exists(single, ignored)) {
    const fs::path built = fs::path(*folder).parent_path() / "dist-single/page.html";
    if (fs::exists(built, ignored)) single = built;
  }
  auto page = view::PageExport::open(single.string());
  if (!page) return tool::report(single.string(), page.error());

  tool::InputFiles inputs;
  inputs.add(single.string());
  std::map<std::string, std::string> address_of;  // by the server's name
  for (const Shown::File& file : shown.files) {
    inputs.add(file.path);
    auto mapped = rgs::MappedFile::open(file.path);
    if (!mapped) return tool::report(file.path, mapped.error());
    mapped->advise(rgs::MappedFile::Access::sequential);
    address_of[file.name] = page->add(*std::move(mapped));
  }
  for (std::size_t i = 0; i < shown.document.scenes.size(); ++i) {
    auto& scene = shown.document.scenes[i];
    scene.url = address_of.at(fmt::format("scenes/{}/{}", i, scene.name));
  }
  for (auto& photo : shown.document.photos) photo.url = address_of.at(photo.url);
  if (!shown.cameras.empty()) shown.document.cameras = page->add(view::cameras_json(shown.cameras));
  page->set_view(view::view_json(shown.document));

  const std::uint64_t bytes = page->bytes();
  if (bytes > options.export_limit) {
    return tool::report_usage(fmt::format(
        "'{}' would have {}, more than --export-limit allows ({}): rgs-convert --profile archive makes smaller "
        "scenes",
        options.export_to, tool::format_bytes(bytes), tool::format_bytes(options.export_limit)));
  }
  inputs.add_cameras(options.cameras);
  const std::vector<std::string> outputs{options.export_to};
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  auto out = rgs::AtomicFile::create(options.export_to, {.overwrite = options.overwrite, .inputs = page->inputs()});
  if (!out) return tool::report(options.export_to, out.error());
  const std::string stated = fmt::format("{}: {}\n", tool::printable(options.export_to), tool::format_bytes(bytes));
  options.export_to == "-" ? tool::print_error(stated) : tool::print(stated);
  tool::flush();
  rgs::Status written = out->reserve(bytes);
  if (written) written = page->write(*out);
  if (written) written = out->commit().map([](double) {});
  return written ? tool::kSuccess : tool::report(options.export_to, written.error());
}

void add_options(CLI::App& app, Options& o) {
  app.add_option("scene", o.scene, "scene: " RGS_PAGE_FORMATS "; without one the page waits for it");
  app.add_option("other", o.other, "second scene, to compare with the first");
  auto* const cameras = app.add_option("--cameras,-c", o.cameras,
                                       "cameras on the page: camera file or COLMAP folder (docs/user/CAMERAS.md)");
  app.add_option("--photos", o.photos, "folder of photographs with the cameras' names; PNG or JPEG")->needs(cameras);

  const std::string single = "One file instead of a server";
  auto* const export_to =
      app.add_option("--export", o.export_to, "write one file with everything in it, which opens without a server")
          ->option_text("PAGE.html")
          ->group(single);
  tool::add_bytes(app, "--export-limit", o.export_limit, "largest size of that file [256MiB]")
      ->needs(export_to)
      ->group(single);
  app.add_flag("--overwrite", o.overwrite, "replace an existing page")->needs(export_to)->group(single);

  const std::string frames = "Reference pictures, drawn on this machine (docs/user/VIEW.md)";
  app.add_option("--backend", o.backend, "draw reference pictures for the page: cpu, cuda [none]")
      ->transform(tool::one_of<rgs::Backend>({{"cpu", rgs::Backend::cpu}, {"cuda", rgs::Backend::cuda}}))
      ->group(frames);
  tool::add_bytes(app, "--host-memory", o.host_memory,
                  "stream .rgs files with levels of detail within this much memory")
      ->group(frames);
  tool::add_bytes(app, "--device-memory", o.device_memory,
                  "the same on the GPU, half for pages, half for the frames' workspace")
      ->group(frames);
  app.add_option("--threads", o.threads, "CPU threads for drawing, 0 for all cores")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str()
      ->group(frames);
  tool::add_max_expansion(app, o.read.limits)->group(frames);
  tool::add_spz_axes(app, o.read.spz_axes);

  app.add_option("--view", o.view, "camera of the first view, by name or index")->needs(cameras);

  const std::string server = "Server";
  app.add_option("--port", o.port, "port on 127.0.0.1, 0 for a free one")
      ->check(CLI::Range(0, 65535))
      ->capture_default_str()
      ->group(server);
  app.add_flag("--no-browser", o.no_browser, "print the address and open no browser")->group(server);
  app.set_version_flag("--version", "rgs-view " RGS_VERSION);
  app.footer("Ctrl-C ends it.\nExit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input.");
}

// Contradictory options; empty if there are none.
std::string contradiction(const Options& o) {
  if (o.scene.empty() && (!o.cameras.empty() || !o.export_to.empty() || has_frames(o)))
    return "--cameras, --export, --backend, --host-memory and --device-memory need a scene; name one";
  if (o.host_memory == std::uint64_t{0}) return "--host-memory of 0 bytes holds no scene";
  if (o.device_memory == std::uint64_t{0}) return "--device-memory of 0 bytes holds no scene";
  if (o.backend == rgs::Backend::cpu && o.device_memory)
    return "--device-memory needs --backend cuda; --host-memory is for the CPU";
  if (o.backend == rgs::Backend::cuda && o.host_memory && !o.device_memory)
    return "--backend cuda streams within --device-memory; give that too, or use --backend cpu";
  if (!o.export_to.empty() && !o.view.empty()) return "--view cannot be combined with --export";
  if (!o.export_to.empty() && has_frames(o))
    return "--export cannot be combined with --backend, --host-memory or --device-memory: an exported page has no "
           "server that draws";
  return {};
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options options;
    CLI::App app{"Shows a 3D Gaussian splat scene, or compares two, on a page in the browser of this machine.",
                 "rgs-view"};
    add_options(app, options);
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    if (const std::string wrong = contradiction(options); !wrong.empty()) return tool::report_usage(wrong);
    Shown shown;
    if (const int code = look_at(options, shown); code != tool::kSuccess) return code;
    return options.export_to.empty() ? serve(options, shown) : export_page(options, shown);
  });
}
