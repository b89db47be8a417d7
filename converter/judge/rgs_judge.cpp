// rgs_judge.cpp - rgs-judge: why a scene looks different in another program. Arguments and exit codes; judge.cpp works.
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <tbb/global_control.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "audit_folder.hpp"
#include "audit_scenes.hpp"
#include "audit_source.hpp"
#include "audit_views.hpp"
#include "camera_choice.hpp"
#include "command_line.hpp"
#include "console.hpp"
#include "input_files.hpp"
#include "judge_report.hpp"
#include "max_expansion.hpp"
#include "rgs/file.hpp"
#include "rgs/version.hpp"
#include "scene_file.hpp"
#include "sibling_program.hpp"
#include "spz_axes.hpp"

namespace {

namespace fs = std::filesystem;
namespace audit = rgs::audit;
namespace judge = rgs::judge;
namespace tool = rgs::tool;

struct Arguments {
  std::string scene, against, client, clients = "web/clients", size, json, report, pictures;
  audit::Options views;
  float near_plane = rgs::math::kNearPlane;
  int threads = 0;
  bool overwrite = false, quiet = false;
};

std::string client_names() {
  std::string names;
  for (const judge::Client& c : judge::clients()) names += (names.empty() ? "" : ", ") + std::string(c.key);
  return names;
}

int io_error(const std::string& path, rgs::Errc code, const char* what) {
  return tool::report(path, {code, rgs::Error::kNone, what});
}

// A folder that is gone with this value; a signal that ends the program leaves it.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::error_code failed;
    std::string name = (fs::temp_directory_path(failed) / "rgs-judge-XXXXXX").string();
    if (!failed && ::mkdtemp(name.data()) != nullptr) path_ = name;
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  ~TemporaryFolder() {
    std::error_code ignored;
    if (!path_.empty()) fs::remove_all(path_, ignored);
  }
  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

constexpr int kNoProgram = 127;  // of env

// Has the program draw its pictures into `folder`.
int draw_by_client(const Arguments& a, const std::string& folder) {
  const std::string script = (fs::path(a.clients) / "draw.mjs").string();
  if (!fs::exists(script))
    return io_error(
        script, rgs::Errc::open_failed,
        "it draws by other programs: name its folder with --clients (web/clients of a checkout, after npm ci "
        "in web), or have --against name a folder of pictures");
  const std::string jobs = (fs::path(folder) / "jobs.json").string();
  const nlohmann::json list = nlohmann::json::array({{{"scene", fs::absolute(a.scene).string()},
                                                      {"cameras", fs::absolute(a.views.cameras).string()},
                                                      {"near", a.near_plane},
                                                      {"out", folder}}});
  if (!(std::ofstream(jobs) << list.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace) << std::flush))
    return io_error(jobs, rgs::Errc::write_failed, "cannot write; name a folder with room by TMPDIR");
  // Standard output may be the JSON.
  const auto code = tool::run_program_and_wait("/usr/bin/env", {"node", script, a.against, jobs}, STDERR_FILENO);
  if (!code) return tool::report("node", code.error());
  if (*code == kNoProgram) return io_error("node", rgs::Errc::open_failed, "not found; install Node.js, 22 or later");
  return *code == 0 ? tool::kSuccess : io_error(script, rgs::Errc::read_failed, "no pictures were drawn, as it said");
}

constexpr std::size_t kMostFacts = 1 << 20;  // bytes

std::string facts_of(const std::string& folder) {
  return (fs::path(folder) / "client.json").string();
}

// What draw.mjs says of its pictures, if they are from there.
int read_client(const std::string& folder, Arguments& a, judge::Report& report) {
  const std::string path = facts_of(folder);
  if (std::error_code ignored; !fs::exists(path, ignored)) return tool::kSuccess;
  const auto file = rgs::MappedFile::open(path);
  if (!file) return tool::report(path, file.error());
  const auto bytes = file->bytes();
  if (bytes.size() > kMostFacts)
    return tool::report(path, {rgs::Errc::limit_exceeded, rgs::Error::kNone,
                               "too many bytes for what draw.mjs writes; remove or mend it", kMostFacts, bytes.size()});
  const auto* const first = reinterpret_cast<const char*>(bytes.data());
  const auto facts = nlohmann::json::parse(first, first + bytes.size(), nullptr, false);
  if (!facts.is_object())
    return tool::report(
        path, {rgs::Errc::bad_value, rgs::Error::kNone, "not a JSON object as draw.mjs writes it; remove or mend it"});
  const auto word = [&facts](const char* key) {
    const auto found = facts.find(key);
    return found != facts.end() && found->is_string() ? found->get<std::string>() : std::string();
  };
  if (const std::string error = word("error"); !error.empty())
    return tool::report(fmt::format("{}: {}", path, error),
                        {rgs::Errc::unsupported_feature, rgs::Error::kNone, "the program did not draw the scene"});
  if (a.client.empty()) a.client = word("key");
  if (const std::string name = word("client"); !name.empty()) report.client = name;
  report.version = word("version"), report.browser = word("browser");
  return tool::kSuccess;
}

// Fails early instead of after the work.
int check_outputs(const Arguments& a, const std::vector<std::string>& pictures, const tool::InputFiles& inputs,
                  bool prints_text) {
  std::vector<std::string> outputs = pictures;
  outputs.insert(outputs.end(), {a.json, a.report, prints_text ? "-" : ""});
  if (const int code = inputs.check_outputs(outputs); code != tool::kSuccess) return code;
  for (const std::string& output : outputs) {
    std::error_code ignored;
    if (!output.empty() && output != "-" && !a.overwrite && fs::exists(output, ignored))
      return io_error(output, rgs::Errc::output_exists, "the output exists; pass --overwrite to replace it");
  }
  return tool::kSuccess;
}

// The cameras, and their pictures if `folder` is given.
audit::Outcome<std::vector<audit::View>> views_of(const Arguments& a, const std::string& folder) {
  audit::Options options = a.views;
  options.photos = folder;
  auto views = audit::choose_views(options, {}, rgs::kNoOrigin);
  if (views &&
      std::ranges::any_of(*views, [](const audit::View& v) { return v.camera.model != rgs::CameraModel::pinhole; }))
    return audit::make_error(options.cameras, {rgs::Errc::unsupported_feature, rgs::Error::kNone,
                                               "other programs draw pinhole cameras alone; name a file with these"});
  return views;
}

int read_pictures(const std::vector<audit::View>& views, judge::Report& report) {
  for (const audit::View& view : views) {
    auto picture = audit::read_photo(view);
    if (!picture) return tool::report(picture.error().subject, picture.error().error);
    if (std::any_of(picture->pixels.begin(), picture->pixels.end(), [](float v) { return std::isnan(v); }))
      return tool::report(view.photo, {rgs::Errc::bad_value, rgs::Error::kNone,
                                       "a value of the picture is not a number; write it again without any"});
    report.shown.push_back({view.camera, *std::move(picture)});
  }
  return tool::kSuccess;
}

int write(const Arguments& a, const std::vector<std::string>& pictures, const judge::Report& report, bool prints_text) {
  if (!a.pictures.empty()) {
    std::error_code failed;
    fs::create_directories(a.pictures, failed);
    if (failed)
      return tool::report(a.pictures, {rgs::Errc::write_failed, rgs::Error::kNone, "cannot make the folder",
                                       rgs::Error::kNone, rgs::Error::kNone, failed.value()});
    if (const auto ok = judge::write_pictures(pictures, report, a.overwrite); !ok)
      return tool::report(ok.error().subject, ok.error().error);
  }
  if (!a.report.empty())
    if (const auto ok = audit::write_text(a.report, judge::page(report), a.overwrite); !ok)
      return tool::report(a.report, ok.error());
  if (!a.json.empty())
    if (const auto ok = audit::write_text(a.json, judge::json(report), a.overwrite); !ok)
      return tool::report(a.json, ok.error());
  if (prints_text) tool::print(judge::text(report));
  return tool::kSuccess;
}

int run(Arguments& a) {
  const std::size_t threads =
      a.threads > 0 ? static_cast<std::size_t>(a.threads) : std::max(1U, std::thread::hardware_concurrency());
  const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
  if (!a.size.empty()) {
    const auto size = tool::parse_size(a.size);
    if (!size) return tool::report_usage("--size takes WxH, sides 1 to 65536, not '" + a.size + "'");
    a.views.size = *size;
  }
  if (!std::isfinite(a.near_plane) || a.near_plane <= 0)
    return tool::report_usage("--near takes a number above 0 that FP32 can hold");
  std::error_code ignored;
  const bool is_folder = fs::is_directory(a.against, ignored);
  if (!is_folder && judge::find_client(a.against) == nullptr)
    return tool::report_usage(
        fmt::format("--against names a folder of pictures or one of {}, not '{}'", client_names(), a.against));
  if (!is_folder && !a.size.empty())
    return tool::report_usage("--size is of pictures in a folder; a client draws at the cameras' own");
  if (!a.client.empty() && judge::find_client(a.client) == nullptr)
    return tool::report_usage(fmt::format("--client is one of {}, not '{}'", client_names(), a.client));

  tool::InputFiles inputs;
  inputs.add_scene(a.scene);
  inputs.add_cameras(a.views.cameras);
  auto views = views_of(a, is_folder ? a.against : "");
  if (!views) return tool::report(views.error().subject, views.error().error);
  for (const audit::View& view : *views) inputs.add(view.photo);
  if (is_folder && fs::exists(facts_of(a.against), ignored)) inputs.add(facts_of(a.against));
  const bool prints_text = !a.quiet && a.json != "-";
  std::vector<std::string> pictures;
  if (!a.pictures.empty()) {
    std::vector<rgs::Camera> cameras;
    for (const audit::View& view : *views) cameras.push_back(view.camera);
    pictures = rgs::picture_paths(a.pictures, cameras, judge::kPictures);
  }
  if (const int code = check_outputs(a, pictures, inputs, prints_text); code != tool::kSuccess) return code;

  const auto file = rgs::load_scene_file(a.scene, a.views.read);
  if (!file) return tool::report(a.scene, file.error());
  const auto& declared = file->scene.declarations();
  // The Gaussians as a program sees them that ignores the declared axes.
  const auto source = audit::Source::open(a.scene, a.views.read, std::nullopt);
  if (!source) return tool::report(a.scene, source.error());
  const auto raw = audit::source_scene(*source);
  if (!raw) return tool::report(a.scene, raw.error());
  const auto defined = file->scene.view();
  if (!defined) return tool::report(a.scene, defined.error());
  const auto stored = raw->scene.view();
  if (!stored) return tool::report(a.scene, stored.error());

  judge::Report report;
  report.scene = fs::path(a.scene).filename().string();
  report.gaussians = defined->n;
  report.client = "the program";
  TemporaryFolder drawn;
  std::string folder = a.against;
  if (!is_folder) {
    if (drawn.path().empty())
      return io_error("", rgs::Errc::write_failed, "cannot make a temporary folder; name a folder for it by TMPDIR");
    for (const audit::View& view : *views)
      if (view.camera.name.empty())
        return tool::report(a.views.cameras, {rgs::Errc::bad_argument, rgs::Error::kNone,
                                              "a camera has no name, by which its picture is found; give it one"});
    folder = drawn.path();
    if (const int code = draw_by_client(a, folder); code != tool::kSuccess) return code;
  }
  if (const int code = read_client(folder, a, report); code != tool::kSuccess) return code;
  if (!is_folder) views = views_of(a, folder);
  if (!views) return tool::report(views.error().subject, views.error().error);
  if (const int code = read_pictures(*views, report); code != tool::kSuccess) return code;
  const judge::Client* client = judge::find_client(a.client);
  if (client != nullptr) report.client = client->name;
  report.found = judge::judge({*defined, *stored}, report.shown, judge::definition(declared, a.near_plane), client);
  if (const int code = inputs.check_unchanged(); code != tool::kSuccess) return code;
  return write(a, pictures, report, prints_text);
}

void add_options(CLI::App& app, Arguments& a) {
  app.add_option("scene", a.scene, "a scene, " + rgs::format_list() + "; its content decides")->required();
  app.add_option("--cameras", a.views.cameras, "camera file or COLMAP folder (docs/user/CAMERAS.md)")->required();
  app.add_option("--against", a.against,
                 "who else draws it: a folder of pictures named like the cameras, or " + client_names() +
                     ", which then draws them in a browser")
      ->required()
      ->option_text("FOLDER|CLIENT");
  app.add_option("--client", a.client,
                 "whose rules are tried first; what the folder's client.json says, if it is absent")
      ->option_text("CLIENT");
  app.add_option("--clients", a.clients, "folder of draw.mjs, for --against CLIENT")
      ->option_text("FOLDER")
      ->capture_default_str();
  app.add_option("--split", a.views.split, "cameras: train, test or all")
      ->check(CLI::IsMember({"train", "test", "all"}));
  app.add_option("--size", a.size, "WxH pixels of the pictures of a folder [the cameras' own]");
  app.add_option("--near", a.near_plane, "near plane, world units")->check(CLI::PositiveNumber)->capture_default_str();
  app.add_option("--json", a.json, "write the result as JSON (docs/user/JUDGE.md); - for standard output")
      ->option_text("FILE");
  app.add_option("--report", a.report, "write a page with causes and pictures")->option_text("FILE");
  app.add_option("--pictures", a.pictures, "write the pictures of the page as PNG")->option_text("FOLDER");
  app.add_option("--threads", a.threads, "CPU threads, 0 for all cores; no result depends on it")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  tool::add_max_expansion(app, a.views.read.limits);
  tool::add_spz_axes(app, a.views.read.spz_axes);
  app.add_flag("--overwrite", a.overwrite, "replace existing outputs");
  app.add_flag("--quiet,-q", a.quiet, "print nothing on standard output");
  app.set_version_flag("--version", "rgs-judge " RGS_VERSION);
  app.footer("Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed or unsupported input.");
}

}  // namespace

int main(int argc, char** argv) {
  return tool::run([&]() -> int {
    Arguments arguments;
    CLI::App app{"Says why a scene looks different in another program, cause by cause.", "rgs-judge"};
    add_options(app, arguments);
    if (const auto ended = tool::parse(app, argc, argv)) return *ended;
    return run(arguments);
  });
}
