// rgs_view.cpp - rgs-view: a page that shows a scene, or two beside each other, in the browser of this machine.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <signal.h>
#include <unistd.h>

#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "browser.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "http_server.hpp"
#include "input_files.hpp"
#include "photo_folder.hpp"
#include "rgs/camera_file.hpp"
#include "rgs/file.hpp"
#include "rgs/interchange.hpp"
#include "rgs/version.hpp"
#include "sibling_program.hpp"
#include "view_documents.hpp"
#include "view_site.hpp"

namespace {

namespace fs = std::filesystem;
namespace tool = rgs::tool;
namespace view = rgs::view;

struct Options {
  std::string scene, other, cameras, photos;
  int port = 0;
  bool no_browser = false;
};

// What is looked at, by the names that the page has for it.
struct Shown {
  struct File {
    std::string name, path;
  };
  std::vector<File> files;
  view::ViewDocument document;
  std::vector<rgs::Camera> cameras;
};

int add_scene(const std::string& path, Shown& shown) {
  const auto file = rgs::MappedFile::open(path);
  if (!file) return tool::report(path, file.error());
  if (rgs::detect_format(file->bytes()) == rgs::SplatFormat::unknown)
    return tool::report(path, {rgs::Errc::bad_magic, 0, "no splat file: rgs-view shows " RGS_SCENE_FORMATS});
  const std::string folder = fmt::format("scenes/{}/", shown.document.scenes.size());
  tool::InputFiles files;  // of a SOG's meta.json also the pictures
  files.add_scene(path);
  for (const std::string& part : files.paths())
    shown.files.push_back({folder + fs::path(part).filename().string(), part});
  const std::string name = fs::path(path).filename().string();
  shown.document.scenes.push_back({name, folder + view::percent_encoded(name), file->bytes().size()});
  return tool::kSuccess;
}

int add_photos(const std::string& folder, Shown& shown) {
  const auto photos = rgs::PhotoFolder::open(folder);
  if (!photos) return tool::report(folder, photos.error());
  for (const rgs::Camera& camera : shown.cameras) {
    const std::string path = photos->find(camera.name);
    // Browsers show neither TIFF nor OpenEXR.
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
  for (const std::string* scene : {&options.scene, &options.other}) {
    if (scene->empty()) continue;
    if (const int code = add_scene(*scene, shown); code != tool::kSuccess) return code;
  }
  if (options.cameras.empty()) return tool::kSuccess;
  auto cameras = rgs::read_cameras(options.cameras);
  if (!cameras) return tool::report(options.cameras, cameras.error());
  shown.cameras = *std::move(cameras);
  shown.document.cameras = "cameras.json";
  return options.photos.empty() ? tool::kSuccess : add_photos(options.photos, shown);
}

// The folder of the built page: where the environment says, beside this program as it is installed, in the build tree.
rgs::Result<std::string> page_folder() {
  if (const char* named = std::getenv("RGS_VIEWER_DIR"); named != nullptr && *named != '\0') return std::string(named);
  std::vector<fs::path> places;
  if (const auto folder = tool::program_folder())
    places.push_back(fs::path(*folder).parent_path() / "share/roofgs/viewer");
  places.emplace_back(RGS_VIEWER_BUILD_DIR);
  std::error_code ignored;
  for (const fs::path& place : places)
    if (fs::exists(place / "index.html", ignored)) return place.string();
  return rgs::make_error(
      rgs::Errc::open_failed, rgs::Error::kNone,
      "the viewer's page is not installed: build web/ (sh scripts/test_web.sh), or name its folder by "
      "RGS_VIEWER_DIR");
}

// Ctrl-C is how a server ends, so it is a success; it leaves nothing behind but what the system takes back. Blocked here and in all
// threads to come, signals wait for the thread that takes them. What was ignored (nohup) stays so.
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

int serve(const Options& options, const Shown& shown) {
  end_on_signals();
  const auto folder = page_folder();
  if (!folder) return tool::report("", folder.error());
  auto token = view::random_token();
  if (!token) return tool::report("", token.error());
  auto server = view::HttpServer::listen(options.port);
  if (!server) return tool::report(fmt::format("127.0.0.1:{}", options.port), server.error());

  view::ViewSite site(*std::move(token), server->port());
  if (const rgs::Status added = site.add_page(*folder); !added) return tool::report(*folder, added.error());
  for (const Shown::File& file : shown.files)
    if (const rgs::Status added = site.add_file(file.name, file.path); !added)
      return tool::report(file.path, added.error());
  if (!shown.cameras.empty()) site.add_json("cameras.json", view::cameras_json(shown.cameras));
  site.add_json("view.json", view::view_json(shown.document));

  tool::print(site.address() + "\n");
  tool::flush();
  if (!options.no_browser && view::has_screen() && !view::open_browser(site.address()))
    tool::print_error("rgs-view: xdg-open does not start: open the address in a browser\n");
  server->serve(site.handlers());
  return tool::report("", {rgs::Errc::internal, rgs::Error::kNone, "the server ended by itself"});
}

void add_options(CLI::App& app, Options& o) {
  app.add_option("scene", o.scene, "scene to look at, " RGS_SCENE_FORMATS)->required();
  app.add_option("other", o.other, "a second one, to compare it with");
  auto* const cameras =
      app.add_option("--cameras,-c", o.cameras, "cameras to jump to: camera file or COLMAP folder (docs/CAMERAS.md)");
  app.add_option("--photos", o.photos, "folder of the cameras' photographs, by name; PNG or JPEG")->needs(cameras);

  const std::string server = "Server";
  app.add_option("--port", o.port, "port on 127.0.0.1, 0 for a free one")
      ->check(CLI::Range(0, 65535))
      ->capture_default_str()
      ->group(server);
  app.add_flag("--no-browser", o.no_browser, "print the address and open no browser")->group(server);
  app.set_version_flag("--version", "rgs-view " RGS_VERSION);
  app.footer("Ctrl-C ends it.\nExit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input.");
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Options options;
    CLI::App app{"Shows a 3D Gaussian splat scene, or two to compare, on a page in the browser of this machine.",
                 "rgs-view"};
    add_options(app, options);
    if (const auto code = tool::parse(app, argc, argv)) return *code;
    Shown shown;
    if (const int code = look_at(options, shown); code != tool::kSuccess) return code;
    return serve(options, shown);
  });
}
