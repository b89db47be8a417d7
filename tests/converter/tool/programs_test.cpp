// programs_test.cpp - behaviour of all programs: closed or full standard streams, names that would control a terminal,
// invalid values, outputs that are inputs, changing inputs, little memory, messages as JSON, --help.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <regex>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "checkout.hpp"
#include "counted_program.hpp"
#include "edit_file.hpp"
#include "file_times.hpp"
#include "golden_scenes.hpp"
#include "info_escape.hpp"
#include "ply_samples.hpp"
#include "rgs/decode.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;
using Json = nlohmann::json;

namespace {

using Arguments = std::vector<std::string>;

const Arguments kPrograms = [] {     // paths
  Arguments programs{RGS_PROGRAMS};  // names, set by CMake
  for (std::string& program : programs) program = built(program);
  return programs;
}();

std::string program(const std::string& name) {
  for (const std::string& path : kPrograms)
    if (fs::path(path).filename() == name) return path;
  return {};
}

constexpr const char* kCameras = R"([{"name":"a.jpg","split":"test","width":32,"height":24,"fx":30,"fy":30,)"
                                 R"("world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,8],[0,0,0,1]]}])";

// A folder with a scene as PLY and .rgs, and cameras.
struct Scene {
  explicit Scene(std::uint64_t n = 300)
      : ply(folder.file("scene.ply")), rgs(folder.file("scene.rgs")), cameras(folder.file("cameras.json")) {
    std::vector<Splat> splats;
    const SplatCloud cloud = golden_cloud(n, 1, 5);
    for (std::uint64_t i = 0; i < n; ++i) splats.push_back(cloud.view().splat(i));
    write_text(ply, binary_ply(splats, 1));
    write_text(cameras, kCameras);
    REQUIRE(run_program({program("rgs-convert"), "--quiet", "--no-sync", ply, rgs}).exit_code == 0);
  }
  TemporaryFolder folder;
  std::string ply, rgs, cameras;

  std::string file(const std::string& name) const { return folder.file(name); }
  // A successful run of each program that prints to both streams; its output, if any, is `out`.
  std::vector<Arguments> runs(const std::string& out) const {
    std::vector<Arguments> all{
        {program("rgs-convert"), "--overwrite", "--no-sync", ply, out + ".rgs"},
        {program("rgs-info"), rgs},
        {program("rgs-audit"), ply, rgs, "--no-render", "--overwrite", "-o", out + ".html"},
        {program("rgs-prune"), ply, out + ".ply", "-c", cameras, "--keep", "50%", "--overwrite", "--no-sync"},
        {program("rgs-render"), rgs, "-o", out + ".png", "-c", cameras, "--overwrite", "--backend", "cpu"},
        {program("rgs-make-scene"), out + ".ply", "--gaussians", "100", "--overwrite", "--no-sync"}};
    std::erase_if(all, [](const Arguments& a) { return a.front().empty(); });
    return all;
  }
};

// Text that controls a terminal, misleads its reader, or is not text.
std::string harmful(const std::string& text) {
  std::string lines;
  // Line ends are ours; everything else must look escaped, with doubled backslashes.
  for (const char c : text)
    if (c != '\n' && c != '\\') lines += c;
  const std::string escaped = tool::escape_untrusted(lines, false, ~std::size_t{0});
  return escaped == lines ? "" : escaped;
}

const std::string kHostile = "x\x1b]0;t\a\x1b[2J\x7f\xe2\x80\xae\xe2\x81\xa6\xe2\x80\x8f\xff\xc2\x9b y\r.ply";

std::function<void()> closed(std::initializer_list<int> streams) {
  return [streams = std::vector<int>(streams)] {
    for (const int fd : streams) ::close(fd);
  };
}

std::function<void()> full(int stream) {
  return [stream] { ::dup2(::open("/dev/full", O_WRONLY), stream); };
}

// Options with values in a program's --help, with the text beside them.
struct Option {
  std::string name, text;
};
std::vector<Option> options_of(const std::string& path) {
  std::vector<Option> options;
  std::istringstream help(run_program({path, "--help"}).out);
  const std::regex line(R"(^\s+(?:-\w,)?(--[a-z-]+) (\S.*)$)");
  for (std::string text; std::getline(help, text);) {
    std::smatch found;
    // A flag's text starts behind columns of spaces; a value's type or text directly behind the name.
    if (std::regex_match(text, found, line) && found[2].str().front() != ' ') options.push_back({found[1], found[2]});
  }
  return options;
}

std::set<std::string> names_in(const fs::path& folder) {
  std::set<std::string> names;
  for (const auto& entry : fs::directory_iterator(folder)) names.insert(entry.path().filename().string());
  return names;
}

// The JSON lines of a program's standard error, by kind; there may be no others.
std::map<std::string, std::vector<Json>> messages_of(const ProgramResult& result) {
  std::map<std::string, std::vector<Json>> messages;
  std::istringstream lines(result.err);
  for (std::string line; std::getline(lines, line);) {
    CAPTURE(line);
    const Json message = Json::parse(line, nullptr, false);
    REQUIRE(message.is_object());
    REQUIRE(message.size() == 1);
    messages[message.begin().key()].push_back(message.begin().value());
  }
  return messages;
}

}  // namespace

TEST_CASE("every --help lists the exit codes and the inputs") {
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    const ProgramResult help = run_program({path, "--help"});
    CHECK(help.exit_code == 0);
    CHECK(help.err.empty());
    const std::string name = fs::path(path).filename().string();
    const std::size_t codes = help.out.find("Exit codes: 0 ");
    REQUIRE(codes != help.out.npos);
    for (const char* code : {" 1 ", " 2 ", " 3 "}) CHECK(help.out.find(code, codes) != help.out.npos);
    CHECK((help.out.find(" 4 ", codes) != help.out.npos) == (name != "rgs-make-scene"));
    if (name == "rgs-convert" || name == "rgs-audit" || name == "rgs-diff" || name == "rgs-judge" ||
        name == "rgs-prune" || name == "rgs-render" || name == "rgs-view") {
      for (const std::string format : {".rgs", " .ply", ".compressed.ply", ".sog", ".spz", ".splat", ".ksplat", ".glb",
                                       ".usda", ".usdz", ".npz", ".pt", ".rad"}) {
        CAPTURE(format);
        const bool is_shown = format != ".splat" && format != ".ksplat" && format != ".glb" &&
                              !format.starts_with(".usd") && format != ".npz" && format != ".pt" && format != ".rad";
        CHECK((help.out.find(format) != help.out.npos) ==
              (is_shown || name != "rgs-view"));  // only those that its page shows
      }
    }
    const ProgramResult version = run_program({path, "--version"});
    CHECK(version.exit_code == 0);
    CHECK(version.out.starts_with(name + " "));
  }
}

TEST_CASE("with RGS_MESSAGES=json progress and errors are lines of JSON") {
  const auto as_json = [] { ::setenv("RGS_MESSAGES", "json", 1); };
  const Scene scene;
  for (const Arguments& run : scene.runs(scene.file("out"))) {
    CAPTURE(run.front());
    const ProgramResult result = run_program(run, as_json);
    CHECK(result.exit_code == 0);
    auto messages = messages_of(result);
    CHECK_FALSE(messages.contains("error"));
    if (fs::path(run.front()).filename() == "rgs-info") continue;  // it prints no progress
    REQUIRE_FALSE(messages["progress"].empty());
    Json last;
    for (const Json& at : messages["progress"]) {
      REQUIRE(at.size() == 4);
      CHECK(at.at("stage").is_string());
      CHECK(at.at("unit").is_string());
      // Within a stage it grows, and not beyond the known total.
      if (last.is_object() && last.at("stage") == at.at("stage")) CHECK(at.at("done") >= last.at("done"));
      if (at.at("total") != 0) CHECK(at.at("done") <= at.at("total"));
      last = at;
    }
    CHECK((last.at("total") == 0 || last.at("done") == last.at("total")));
    // Other values of the variable do not request JSON.
    const ProgramResult plain = run_program(run, [] { ::setenv("RGS_MESSAGES", "JSON", 1); });
    CHECK(plain.exit_code == 0);
    CHECK(plain.err.find('{') == plain.err.npos);
  }
  const auto error_of = [&](const Arguments& run, int code) {
    const ProgramResult result = run_program(run, as_json);
    CHECK(result.exit_code == code);
    auto errors = messages_of(result)["error"];
    REQUIRE(errors.size() == 1);
    CHECK(errors[0].size() == 8);
    return errors[0];
  };
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    const Json wrong = error_of({path, "--no-such-option"}, 2);
    CHECK(wrong.at("code") == "bad_argument");
    for (const char* number : {"file", "offset", "expected", "found"}) CHECK(wrong.at(number).is_null());
    CHECK(wrong.at("system") == 0);
    CHECK_FALSE(wrong.at("message").get<std::string>().empty());
  }
  // Names are the files' own, not the printed form; invalid UTF-8 is replaced, so the line stays valid.
  const std::string missing = scene.file("a \"b\"\n\x1b[2J\xff.ply");
  const Json absent = error_of({program("rgs-convert"), missing, scene.file("never.rgs")}, 3);
  CHECK(absent.at("code") == "open_failed");
  CHECK(absent.at("file") == scene.file("a \"b\"\n\x1b[2J\xef\xbf\xbd.ply"));
  CHECK(absent.at("system") == ENOENT);
  CHECK(absent.at("hint").get<std::string>().find("spelling") != std::string::npos);
  // Numbers are numbers, in the fields and in the text.
  const auto size = fs::file_size(scene.rgs);
  fs::resize_file(scene.rgs, size - 100);
  const Json cut = error_of({program("rgs-info"), "--verify", scene.rgs}, 4);
  CHECK(cut.at("file") == scene.rgs);
  CHECK(cut.at("offset").is_number_unsigned());
  CHECK(cut.at("expected") == size);
  CHECK(cut.at("found") == size - 100);
  CHECK(cut.at("message").get<std::string>().find("byte " + std::to_string(cut.at("offset").get<std::uint64_t>())) ==
        0);
}

TEST_CASE("output that cannot be written to a standard stream is exit code 3") {
  const Scene scene;
  for (const Arguments& run : scene.runs(scene.file("out"))) {
    CAPTURE(run.front());
    CHECK(run_program(run).exit_code == 0);
    const ProgramResult on_full = run_program(run, full(STDOUT_FILENO));
    CHECK(on_full.exit_code == 3);
    CHECK(on_full.err.find("No space left on device") != std::string::npos);
    CHECK(run_program(run, closed({STDOUT_FILENO})).exit_code == 3);
    CHECK(run_program(run, closed({STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO})).exit_code == 3);
    if (fs::path(run.front()).filename() != "rgs-info") {  // it prints no progress
      CHECK(run_program(run, closed({STDERR_FILENO})).exit_code == 3);
      CHECK(run_program(run, full(STDERR_FILENO)).exit_code == 3);
    }
    // Refusals keep their code when nobody can read them.
    for (const auto& prepare : {closed({STDERR_FILENO}), closed({STDOUT_FILENO, STDERR_FILENO}), full(STDERR_FILENO)}) {
      CHECK(run_program({run.front(), "--no-such-option"}, prepare).exit_code == 2);
    }
  }
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    CHECK(run_program({path, "--help"}, full(STDOUT_FILENO)).exit_code == 3);
    CHECK(run_program({path, "--version"}, closed({STDOUT_FILENO})).exit_code == 3);
  }
}

TEST_CASE("JSON that cannot be written is exit code 3") {
  const Scene scene;
  for (Arguments run : scene.runs(scene.file("out"))) {
    const std::string name = fs::path(run.front()).filename().string();
    CAPTURE(name);
    if (name == "rgs-make-scene") continue;
    run.push_back("--json");
    if (name == "rgs-audit") run.push_back("-");
    CHECK(run_program(run).exit_code == 0);
    CHECK(run_program(run, full(STDOUT_FILENO)).exit_code == 3);
    CHECK(run_program(run, closed({STDOUT_FILENO})).exit_code == 3);
  }
}

TEST_CASE("messages never mix with an output") {
  const Scene scene;
  const std::string out = scene.file("o");
  for (const Arguments& run : scene.runs(out)) {
    CAPTURE(run.front());
    const auto content = [&] {
      std::string all;
      for (const char* end : {".rgs", ".html", ".ply", ".png"}) all += read_text(out + end);
      // Reports state the time taken.
      return fs::path(run.front()).filename() == "rgs-audit" ? std::string() : all;
    };
    REQUIRE(run_program(run).exit_code == 0);
    const std::string expected = content();
    for (const auto& prepare : {closed({STDERR_FILENO}), closed({STDOUT_FILENO, STDERR_FILENO}),
                                closed({STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}), closed({STDIN_FILENO})}) {
      const ProgramResult result = run_program(run, prepare);
      CHECK(result.signal == 0);
      CHECK((result.exit_code == 0 || result.exit_code == 3));
      CHECK(content() == expected);
    }
  }
  CHECK(std::ranges::none_of(names_in(scene.folder.path()),
                             [](const std::string& name) { return name.find(".tmp-") != name.npos; }));
}

TEST_CASE("an output to standard output that is closed or full is exit code 3") {
  const Scene scene;
  const Arguments run{program("rgs-convert"), "--quiet", "--to", "rgs", scene.ply, "-"};
  CHECK(run_program(run).exit_code == 0);
  CHECK(run_program(run, closed({STDOUT_FILENO})).exit_code == 3);
  CHECK(run_program(run, full(STDOUT_FILENO)).exit_code == 3);
  CHECK(
      run_program({program("rgs-convert"), "--quiet", "-", scene.file("out.rgs")}, closed({STDIN_FILENO})).exit_code ==
      3);
}

TEST_CASE("names and values from outside are printed without controlling a terminal") {
  const Scene scene;
  const std::string hostile = scene.file(kHostile), link = scene.file("\x1b[31mrgs");
  const std::string absent = scene.file("no folder/" + kHostile);  // where nothing can be written either
  fs::copy_file(scene.ply, hostile);
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    const auto check = [&](const Arguments& arguments, const std::string& under = {}) {
      Arguments run{under.empty() ? path : under};
      run.insert(run.end(), arguments.begin(), arguments.end());
      const ProgramResult result = run_program(run);
      CAPTURE(arguments);
      CHECK(harmful(result.err) == "");
      CHECK(harmful(result.out) == "");
      return result.exit_code;
    };
    CHECK(check({"--" + kHostile}) == 2);
    CHECK(check({absent}) != 0);
    check({absent, absent});
    check({absent + "1", absent + "2", absent + "3"});
    const bool makes = fs::path(path).filename() == "rgs-make-scene";
    int n_options = 0;
    for (const Option& option : options_of(path)) {
      if (kSanitized && n_options++ % 4 != 0) continue;  // each run takes a second
      // Numbers share one check, and each run takes time.
      if (std::regex_search(option.text, std::regex("^U?INT|^FLOAT")) && option.name != "--threads") continue;
      CAPTURE(option.name);
      // Everything else is valid, so that the value is checked.
      Arguments run{scene.ply, scene.file("o.rgs"), option.name, absent};
      if (makes) run.erase(run.begin());
      if (option.name != "--cameras") run.insert(run.end(), {"--cameras", scene.cameras});
      check(run);
    }
    fs::remove(link);
    fs::create_symlink(path, link);  // the program's argv[0]
    CHECK(check({"--no-such-option"}, link) == 2);
  }
  // The files exist, so that summaries print their names.
  Scene other;
  fs::rename(other.ply, other.file(kHostile));
  other.ply = other.file(kHostile);
  fs::rename(other.rgs, other.file(kHostile + ".rgs"));
  other.rgs = other.file(kHostile + ".rgs");
  for (Arguments run : other.runs(other.file("\x1b\xe2\x80\xae\xff"))) {
    CAPTURE(run.front());
    for (const bool json : {false, true}) {
      if (json && fs::path(run.front()).filename() == "rgs-make-scene") continue;
      if (json) run.push_back("--json");
      if (json && fs::path(run.front()).filename() == "rgs-audit") run.push_back("-");
      const ProgramResult result = run_program(run);
      CAPTURE(result.err);
      CHECK(result.exit_code == 0);
      CHECK(harmful(result.err) == "");
      CHECK(harmful(result.out) == "");
    }
  }
}

TEST_CASE("no option accepts an empty value, and no number that is not finite") {
  const Scene scene;
  int n_numbers = 0;
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    // All options share one check, and each run takes time: one with a separate value, one with it attached.
    for (const bool apart : {false, true}) {
      const std::string name = options_of(path).at(apart ? 1 : 0).name;
      CAPTURE(name);
      Arguments run{path, scene.ply, scene.file("never.ply"), apart ? name : name + "="};
      if (apart) run.emplace_back();
      const ProgramResult result = run_program(run);
      CHECK(result.exit_code == 2);
      CHECK(result.err.find(name + " has an empty value") != std::string::npos);
    }
    for (const Option& option : options_of(path)) {
      if (option.text.find("FLOAT") == std::string::npos) continue;
      CAPTURE(option.name);
      const char* const value = std::array{"nan", "inf", "-Infinity"}[static_cast<std::size_t>(n_numbers++) % 3];
      CAPTURE(value);
      CHECK(
          run_program({path, scene.ply, scene.file("never.ply"), "--cameras", scene.cameras, option.name + "=" + value})
              .exit_code == 2);
    }
    CHECK(run_program({path, ""}).exit_code == 2);
  }
  CHECK(n_numbers > 10);
  // Several numbers in one option.
  for (const char* origin : {"nan,0,0", "0,-nan,0", "0,0,inf"}) {
    CAPTURE(origin);
    CHECK(run_program({program("rgs-make-scene"), scene.file("never.ply"), "--gaussians", "10", "--origin", origin})
              .exit_code == 2);
  }
  CHECK_FALSE(fs::exists(scene.file("never.ply")));
}

TEST_CASE("every option of a size in bytes says what it takes") {
  const Scene scene;
  int n_sizes = 0;
  for (const std::string& path : kPrograms) {
    CAPTURE(path);
    for (const Option& option : options_of(path)) {
      if (!option.text.starts_with("BYTES")) continue;
      CAPTURE(option.name);
      const ProgramResult result = run_program({path, scene.ply, scene.file("never.ply"), option.name + "=3.5XB"});
      CHECK(result.exit_code == 2);
      CHECK(result.err.find(option.name + ": takes a size such as 8GB") != std::string::npos);
      ++n_sizes;
    }
  }
  CHECK(n_sizes >= (program("rgs-view").empty() ? 5 : 8));
}

TEST_CASE("an output that is an input or another output is refused, whatever its name") {
  const Scene scene;
  const std::string hard = scene.file("hard.ply"), soft = scene.file("soft.ply"), around = scene.file("f/../scene.ply"),
                    hard_rgs = scene.file("hard.rgs"), json = scene.file("link.json"), photos = scene.file("photos"),
                    dangling = scene.file("dangling.ply"), sog = scene.file("sog"), folder_link = scene.file("here");
  fs::create_directory(scene.file("f"));
  fs::create_directory(photos);
  fs::create_directory(sog);
  fs::create_hard_link(scene.ply, hard);
  fs::create_hard_link(scene.rgs, hard_rgs);
  fs::create_symlink("scene.ply", soft);
  fs::create_symlink("new.ply", dangling);
  fs::create_symlink(scene.folder.path(), folder_link);
  fs::create_hard_link(scene.cameras, json);
  write_text(photos + "/a.png", "a photograph");
  write_text(sog + "/meta.json", "{}");
  write_text(sog + "/means_l.webp", "a picture");
  const std::string convert = program("rgs-convert"), audit = program("rgs-audit"), prune = program("rgs-prune"),
                    render = program("rgs-render"), make = program("rgs-make-scene"), bench = program("rgs-bench");
  std::vector<Arguments> runs{
      {convert, scene.ply, scene.ply, "--to", "rgs"},
      {convert, scene.ply, hard, "--to", "rgs"},
      {convert, scene.ply, soft, "--to", "rgs"},
      {convert, scene.ply, around, "--to", "rgs"},
      {convert, scene.ply, folder_link + "/scene.ply", "--to", "rgs"},
      {convert, scene.ply, scene.cameras, "--to", "rgs", "--cameras", scene.cameras},
      {convert, scene.ply, json, "--to", "rgs", "--cameras", scene.cameras},
      {convert, "--merge", scene.rgs, scene.ply, hard, "--to", "rgs"},
      {convert, sog + "/meta.json", sog + "/means_l.webp", "--to", "ply"},
      {audit, scene.ply, scene.rgs, "--report", scene.ply},
      {audit, scene.ply, scene.rgs, "--report", hard},
      {audit, scene.ply, scene.rgs, "--json", hard_rgs},
      {audit, scene.ply, scene.rgs, "--report", scene.file("x"), "--json", scene.file("x")},
      {audit, scene.ply, scene.rgs, "--report", scene.file("x"), "--json", scene.file("f/../x")},
      {audit, scene.ply, scene.rgs, "--report", scene.file("x"), "--json", folder_link + "/x"},
      {audit, scene.ply, scene.rgs, "--report", json, "--cameras", scene.cameras},
      {audit, scene.ply, scene.rgs, "--report", photos + "/a.png", "--cameras", scene.cameras, "--photos", photos},
      {audit, scene.ply, scene.rgs, "--report", soft, "--also", scene.ply},
      {prune, scene.ply, hard, "--cameras", scene.cameras, "--keep", "50%"},
      {prune, scene.ply, scene.file("p.ply"), "--cameras", scene.cameras, "--keep", "50%", "--scores", hard},
      {prune, scene.ply, scene.file("p.ply"), "--cameras", scene.cameras, "--keep", "50%", "--scores", json},
      {prune, scene.ply, scene.file("p.ply"), "--cameras", scene.cameras, "--keep", "50%", "--scores",
       scene.file("f/../p.ply")},
      {prune, scene.ply, scene.file("new.ply"), "--cameras", scene.cameras, "--keep", "50%", "--scores", dangling},
      {render, scene.rgs, "--out", scene.file("x.exr"), "--depth", scene.file("f/../x.exr"), "--backend", "cpu"},
      {make, scene.file("m.ply"), "--gaussians", "10", "--cameras", scene.file("f/../m.ply")},
      {bench, scene.rgs, "--cameras", scene.cameras, "--json", json},
      {bench, scene.rgs, "--cameras", scene.cameras, "--csv", scene.rgs},
      {bench, scene.rgs, "--cameras", scene.cameras, "--csv", scene.file("x"), "--svg", folder_link + "/x"},
      {bench, scene.rgs, "--cameras", scene.cameras, "--csv", "-", "--json", "-"},
  };
  // A picture in the scene's place: content decides what a scene is.
  const std::string picture = scene.file("scene.png");
  fs::create_hard_link(scene.rgs, picture);
  runs.push_back({render, scene.rgs, "--out", picture, "--backend", "cpu"});
  runs.push_back({render, scene.rgs, "--out", scene.file("y.png"), "--depth", scene.file("y.exr"), "--cameras",
                  scene.cameras, "--backend", "cpu"});  // the only valid one
  const std::string ply = read_text(scene.ply), rgs = read_text(scene.rgs);
  for (std::size_t i = 0; i < runs.size(); ++i) {
    Arguments run = runs[i];
    if (run.front().empty()) continue;
    run.push_back("--overwrite");
    CAPTURE(run);
    const std::set<std::string> before = names_in(scene.folder.path());
    const ProgramResult result = run_program(run);
    CAPTURE(result.err);
    if (i + 1 == runs.size()) {
      CHECK(result.exit_code == 0);
      continue;
    }
    CHECK(result.exit_code == 2);
    CHECK((result.err.find("is the same file as") != std::string::npos ||
           result.err.find("both need standard output") != std::string::npos ||
           result.err.find("two outputs go to standard output") != std::string::npos));
    CHECK(names_in(scene.folder.path()) == before);
    CHECK(read_text(scene.ply) == ply);
    CHECK(read_text(scene.rgs) == rgs);
    CHECK(read_text(scene.cameras) == kCameras);
    CHECK(read_text(photos + "/a.png") == "a photograph");
  }
}

TEST_CASE("a file behind a standard stream is an input or output like any other") {
  const Scene scene;
  const std::string quoted = "'" + program("rgs-convert") + "' --quiet --no-sync --overwrite ";
  const std::string before = read_text(scene.ply);
  CHECK(run_shell(quoted + "--to rgs - '" + scene.ply + "' <'" + scene.ply + "'").exit_code == 2);
  CHECK(run_shell(quoted + "--to rgs '" + scene.ply + "' - >>'" + scene.ply + "'").exit_code == 2);
  CHECK(read_text(scene.ply) == before);
  // Printed text would get into it.
  for (const Arguments& run : scene.runs(scene.file("out"))) {
    CAPTURE(run);
    std::string line;
    for (const std::string& argument : run) line += "'" + argument + "' ";
    for (const std::string& file :
         {run.front() == program("rgs-make-scene") ? scene.file("out.ply") : scene.ply, scene.rgs}) {
      if (std::ranges::find(run, file) == run.end()) continue;
      write_text(scene.file("out.ply"), "old");
      const std::string content = read_text(file);
      CHECK(run_shell(line + ">>'" + file + "'").exit_code == 2);
      CHECK(read_text(file) == content);
    }
    CHECK(run_shell(line + ">>'" + scene.file("log") + "'").exit_code == 0);
  }
  CHECK(run_program({program("rgs-make-scene"), "-", "--gaussians", "0"}).out.ends_with("end_header\n"));
}

TEST_CASE("reports of folders overwrite none of their inputs") {
  const Scene scene;
  const std::string sources = scene.file("ply"), assets = scene.file("rgs"), cameras = scene.file("views");
  for (const std::string& folder : {sources, assets, cameras}) fs::create_directory(folder);
  fs::copy_file(scene.ply, sources + "/garden.ply");
  fs::copy_file(scene.rgs, assets + "/garden.rgs");
  fs::copy_file(scene.cameras, cameras + "/garden.json");
  const auto audit = [&](const std::string& report) {
    return run_program({program("rgs-audit"), sources, assets, "--cameras", cameras, "--report", report, "--overwrite",
                        "--quiet", "--backend", "cpu"});
  };
  const ProgramResult refused = audit(cameras);
  CHECK(refused.exit_code == 2);
  CHECK(refused.err.find("garden.json") != std::string::npos);
  CHECK(read_text(cameras + "/garden.json") == kCameras);
  fs::copy_file(scene.ply, sources + "/index.ply");
  fs::copy_file(scene.rgs, assets + "/index.rgs");
  CHECK(audit(scene.file("out")).exit_code == 2);  // the pair's page would have the table's name
}

TEST_CASE("an input that changes or shrinks while it is read is exit code 3") {
  const Scene scene(20'000);
  const std::string out = scene.file("out"), ply = read_text(scene.ply), rgs = read_text(scene.rgs);
  const std::string sources = scene.file("ply"), assets = scene.file("rgs"), in_folder = sources + "/scene.ply";
  for (const std::string& folder : {sources, assets}) fs::create_directory(folder);
  fs::create_hard_link(scene.ply, in_folder);
  fs::create_hard_link(scene.rgs, assets + "/scene.rgs");
  std::vector<Arguments> runs = scene.runs(out);
  runs.push_back({program("rgs-audit"), sources, assets, "--no-render", "--overwrite", "-o", out + ".reports"});
  for (const bool shrink : {false, true}) {
    for (const Arguments& run : runs) {
      const std::string name = fs::path(run.front()).filename().string();
      if (name == "rgs-make-scene") continue;  // it reads nothing
      CAPTURE(name);
      CAPTURE(shrink);
      Arguments command = run;
      if (name == "rgs-info") command.insert(command.end(), {"--verify", "--stats"});
      const std::string& input = run[1] == "--overwrite" ? scene.ply : run[1] == sources ? in_folder : run[1];
      const std::string content = input == scene.rgs ? rgs : ply;
      const char* const stage = name == "rgs-convert"  ? "scan"
                                : name == "rgs-audit"  ? "reading"
                                : name == "rgs-render" ? "rendering"
                                                       : "read";
      write_text(input, content);
      Program child(command, failpoint(stage));
      REQUIRE(child.stops());
      wait_for_later_time(input);
      if (shrink) {
        fs::resize_file(input, content.size() / 8);
      } else {
        std::fstream file(input, std::ios::binary | std::ios::in | std::ios::out);
        file.seekp(static_cast<std::streamoff>(content.size() / 2));
        file << std::string(content.size() / 4, '\x40');
      }
      child.send(SIGCONT);
      const ProgramResult result = child.wait();
      CAPTURE(result.err);
      CHECK(result.signal == 0);
      CHECK(result.exit_code == 3);
      write_text(input, content);
    }
  }
  CHECK(std::ranges::none_of(names_in(scene.folder.path()),
                             [](const std::string& name) { return name.find(".tmp-") != name.npos; }));
}

TEST_CASE("a program that gets no more memory says so with exit code 3") {
  if (kSanitized) return skip("sanitizers use more memory");
  const Scene scene(200'000);
  for (const Arguments& run : scene.runs(scene.file("out"))) {
    const std::string name = fs::path(run.front()).filename().string();
    if (name == "rgs-info" || name == "rgs-make-scene") continue;  // little memory is enough for any size
    CAPTURE(name);
    // Failures of libraries before main() are not ours to report.
    const std::int64_t least = run_counted({run.front(), "--help"}).peak_bytes;
    REQUIRE(least > 0);
    bool told = false;
    for (const std::int64_t more : {0, 1, 4, 8, 12, 16, 24, 32}) {
      CAPTURE(more);
      const ProgramResult result = run_counted(run, least + (more << 20)).program;
      CAPTURE(result.err);
      CHECK(result.signal == 0);
      CHECK((result.exit_code == 0 || result.exit_code == 3));
      if (result.exit_code == 3) CHECK(result.err.find("[host_out_of_memory]") != std::string::npos);
      told = told || result.exit_code == 3;
    }
    CHECK(told);
  }
}

TEST_CASE("a program that gets few threads works with those") {
  if (kSanitized) return skip("sanitizers replace the function that starts threads");
  const Scene scene(20'000);
  std::vector<Arguments> runs = scene.runs(scene.file("out"));
  for (const char* more : {"spz", "lod"})
    runs.push_back({program("rgs-convert"), scene.ply, scene.file("few.") + more, "--to",
                    more == std::string("spz") ? "spz" : "rgs", "--overwrite", "--no-sync"});
  runs.back().emplace_back("--lod");
  // A report holds pictures.
  if (!program("rgs-audit").empty())
    runs.push_back({program("rgs-audit"), scene.ply, scene.rgs, "--size", "32x32", "--views", "1", "--worst", "0",
                    "--overwrite", "-o", scene.file("out.html")});
  for (const std::string& path : kPrograms)
    for (const char* option : {"--version", "--help"}) runs.push_back({path, option});
  for (const Arguments& run : runs) {
    CAPTURE(run.front());
    CAPTURE(run.back());
    for (int n = 0; n <= 8; ++n) {
      CAPTURE(n);
      const ProgramResult result = run_program(run, [n] {
        ::setenv("LD_PRELOAD", (binary_dir() + "/lib/librgs_injected_faults.so").c_str(), 1);
        ::setenv("RGS_MOST_THREADS", std::to_string(n).c_str(), 1);
      });
      CAPTURE(result.err);
      CHECK(result.signal == 0);
      CHECK(result.exit_code == 0);
      if (run.back() == scene.file("out.html"))
        CHECK(read_text(run.back()).find("src=\"data:,\"") == std::string::npos);
    }
  }
}

TEST_CASE("the error for a wrong value lists the valid ones") {
  const Scene scene;
  const auto refused = [&](const Arguments& arguments, const char* choice) {
    const ProgramResult result = run_program(arguments);
    CAPTURE(result.err);
    CHECK(result.exit_code == 2);
    CHECK(result.err.find(choice) != std::string::npos);
    CHECK(result.err.find("Could not convert") == std::string::npos);
  };
  const Arguments convert{program("rgs-convert"), scene.ply, scene.file("out.rgs")};
  const auto with = [](Arguments run, const char* option, const char* value) {
    run.insert(run.end(), {option, value});
    return run;
  };
  refused(with(convert, "--to", "html"), "compressed.ply");
  refused(with(convert, "--to", "1"), "compressed.ply");
  refused(with(convert, "--from", "obj"), "ksplat");
  refused(with(convert, "--on-bad", "ignore"), "repair");
  refused(with(convert, "--depth-map", "cubic"), "linear");
  refused(with(convert, "--colour-space", "aces"), "srgb");
  const Arguments prune{program("rgs-prune"), scene.ply, scene.file("out.rgs"), "--cameras", scene.cameras};
  refused(with(prune, "--score", "mean"), "max");
  refused({program("rgs-audit"), scene.ply, scene.rgs, "--backend", "metal"}, "cuda");
  if (!program("rgs-render").empty())
    refused({program("rgs-render"), scene.rgs, "-o", scene.file("o.png"), "--mode", "fast"}, "turbo");
}
