// batch_test.cpp - rgs-convert of folders and lists: its outputs, the files it keeps, and reruns after any
// interruption.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <fcntl.h>
#include <sys/mount.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "convert_scenes.hpp"
#include "data_folder.hpp"
#include "file_times.hpp"
#include "rgs/interchange.hpp"
#include "run_program.hpp"
#include "sanitized.hpp"
#include "skip.hpp"
#include "streamed_output.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;
using nlohmann::json;
namespace fs = std::filesystem;

namespace {

constexpr std::uint64_t kSmall = 300;

struct Batch : ProgramResult {
  std::map<std::string, json> lines;  // by input
  std::size_t n_lines = 0;

  std::size_t count(const std::string& status) const {
    return static_cast<std::size_t>(
        std::ranges::count_if(lines, [&](const auto& line) { return line.second["status"] == status; }));
  }
};

Batch lines_of(ProgramResult run, const std::string& text) {
  Batch batch;
  static_cast<ProgramResult&>(batch) = std::move(run);
  std::istringstream in(text);
  for (std::string line; std::getline(in, line); ++batch.n_lines) {
    const json j = json::parse(line);
    CHECK(j["schema"] == "rgs-convert-scene/1");
    batch.lines[j["input_path"].get<std::string>()] = j;
  }
  return batch;
}

Batch convert_all(std::vector<std::string> arguments, const std::function<void()>& before_exec = {}) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync"});
  ProgramResult run = run_program(arguments, before_exec);
  const std::string text = run.out;
  return lines_of(std::move(run), text);
}

std::string scene(const std::string& path, std::uint64_t seed, std::uint64_t n = kSmall) {
  fs::create_directories(fs::path(path).parent_path());
  return write_scene(path, golden_cloud(n, 1, seed));
}

// All files below a folder with their contents, except the state.
std::map<std::string, std::string> contents(const fs::path& folder) {
  std::map<std::string, std::string> files;
  for (const auto& entry : fs::recursive_directory_iterator(folder)) {
    const std::string name = entry.path().lexically_relative(folder).string();
    if (entry.is_regular_file() && !entry.path().filename().string().starts_with("."))
      files[name] = read_text(entry.path().string());
  }
  return files;
}

std::set<std::string> names(const std::map<std::string, std::string>& files) {
  std::set<std::string> out;
  for (const auto& file : files) out.insert(file.first);
  return out;
}

bool has_temporaries(const fs::path& folder) {
  return std::ranges::any_of(names(contents(folder)),
                             [](const std::string& name) { return name.find(".tmp-") != name.npos; });
}

// Whether a child of the process has stopped itself.
bool has_stopped_child(pid_t parent) {
  const std::string id = std::to_string(parent);
  std::ifstream children("/proc/" + id + "/task/" + id + "/children");
  for (std::string child; children >> child;) {
    const std::string stat = read_text("/proc/" + child + "/stat");  // "ID (NAME) STATE ..."
    if (stat.find(") T ") != stat.npos) return true;
  }
  return false;
}

// in/ with n scenes, and out/.
struct Folders : TemporaryFolder {
  explicit Folders(int n = 0, std::uint64_t n_gaussians = kSmall) {
    fs::create_directory(in);
    for (int i = 0; i < n; ++i)
      scene(in + "/" + std::string(1, static_cast<char>('a' + i)) + ".ply", static_cast<std::uint64_t>(i), n_gaussians);
  }
  std::string in = file("in"), out = file("out");

  std::vector<std::string> command(std::vector<std::string> more = {}) const {
    std::vector<std::string> arguments{in, out, "--to", "rgs"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
};

std::vector<std::string> program(const std::vector<std::string>& arguments) {
  std::vector<std::string> command{built("rgs-convert"), "--no-sync"};
  command.insert(command.end(), arguments.begin(), arguments.end());
  return command;
}

}  // namespace

TEST_CASE("a folder of all formats becomes a folder of the same shape, byte for byte as one by one") {
  const Folders f;
  const SplatCloud cloud = golden_cloud(kSmall, 1, 9);
  scene(f.in + "/a.ply", 1);
  scene(f.in + "/sub/deep/b.PLY", 2);
  scene(f.in + "/no ending", 3);
  scene(f.in + "/scene.v2", 3);
  for (const auto& [name, format] :
       {std::pair("sub/c.spz", SplatFormat::spz), std::pair("sub/d.glb", SplatFormat::glb),
        std::pair("e.splat", SplatFormat::splat), std::pair("sub/f.compressed.ply", SplatFormat::compressed_ply),
        std::pair("g.npz", SplatFormat::npz), std::pair("a.ckpt", SplatFormat::npz)}) {
    const auto bytes = encode_splats(cloud.view(), format);
    REQUIRE(bytes);
    write_text(f.in + "/" + name, {reinterpret_cast<const char*>(bytes->data()), bytes->size()});
  }
  // Poses of cameras and the state of a training, which are no scenes.
  const auto zip_with = [](const std::string& name) {
    std::string file = "PK\x03\x04";
    file.resize(26);
    file += static_cast<char>(name.size());
    file.resize(30);
    return file + name;
  };
  write_text(f.in + "/a.npz", zip_with("poses.npy"));
  write_text(f.in + "/a.pt", zip_with("a/data.pkl"));
  write_text(f.in + "/README.md", "A folder of scenes.");
  write_text(f.in + "/cameras.json", R"([{"means": 3}])");
  write_text(f.in + "/sub/ply.txt", "plywood");
  write_text(f.in + "/sub/photos.zip", "PK\x03\x04 and so on");
  write_text(f.in + "/input.ply", header_of({"x", "y", "z"}, "0", "ascii"));

  const Batch one = convert_all(f.command());
  INFO(one.err);
  CHECK(one.exit_code == 0);
  CHECK(names(contents(f.out)) == std::set<std::string>{"a.rgs", "sub/deep/b.rgs", "no ending.rgs", "scene.v2.rgs",
                                                        "sub/c.rgs", "sub/d.rgs", "e.rgs", "sub/f.rgs", "g.rgs"});
  CHECK(one.count("converted") == 9);
  CHECK(one.count("skipped") == 1);
  CHECK(one.lines.at("input.ply")["error"]["code"] == "not_gaussian_splats");
  CHECK(one.n_lines == 10);
  CHECK(one.err.find("7 other files ignored") != std::string::npos);
  CHECK(one.lines.at("sub/c.spz")["output_path"] == "sub/c.rgs");
  CHECK(one.lines.at("sub/c.spz")["source"]["format"] == "spz");
  CHECK(one.lines.at("a.ply")["output"]["gaussians"] == kSmall);

  const std::string two = f.file("two");
  CHECK(convert_all({f.in, two, "--to", "rgs", "--jobs", "2"}).exit_code == 0);
  CHECK(contents(two) == contents(f.out));
  for (const auto& [name, line] : one.lines) {
    if (line["status"] != "converted") continue;
    const std::string& input = name;
    CAPTURE(input);
    const std::string single = f.file("single.rgs");
    REQUIRE(
        run_program({built("rgs-convert"), "-q", "--no-sync", "--overwrite", f.in + "/" + input, single}).exit_code ==
        0);
    CHECK(read_text(single) == contents(f.out)[line["output_path"].get<std::string>()]);
  }
  // To other formats, from .rgs too.
  CHECK(convert_all({f.out, f.file("spz"), "--to", "spz"}).exit_code == 0);
  CHECK(names(contents(f.file("spz"))).contains("sub/deep/b.spz"));
  CHECK(convert_all({f.out, f.file("small"), "--to", "compressed.ply"}).exit_code == 0);
  CHECK(names(contents(f.file("small"))).contains("sub/deep/b.compressed.ply"));
}

TEST_CASE("an unzipped SOG is one scene, including its pictures") {
  const Folders f;
  const fs::path sog = data_folder() / "formats" / "crop.sog";
  if (!fs::exists(sog)) return skip_without_data("the test data has no SOG");
  const std::string meta = f.file("sog");
  REQUIRE(run_shell("python3 -m zipfile -e '" + sog.string() + "' '" + meta + "'").exit_code == 0);
  fs::copy(meta, f.in + "/one", fs::copy_options::recursive);
  const Batch first = convert_all(f.command());
  INFO(first.err);
  CHECK(first.exit_code == 0);
  CHECK(names(contents(f.out)) == std::set<std::string>{"one/meta.rgs"});
  CHECK(first.err.find("other files") == std::string::npos);
  CHECK(convert_all(f.command()).count("kept") == 1);
}

TEST_CASE("a .gltf is one scene, including its buffer; one without splats is none") {
  const Folders f(1);
  const std::string scene = f.file("scene.glb");
  const auto alone = [](const std::vector<std::string>& arguments) { return run_program(program(arguments)); };
  REQUIRE(alone({f.in + "/a.ply", scene}).exit_code == 0);
  const std::string glb = read_text(scene);
  const std::size_t json_bytes =
      std::to_integer<std::size_t>(std::byte(glb[12])) + 256 * std::to_integer<std::size_t>(std::byte(glb[13]));
  json root = json::parse(glb.substr(20, json_bytes));
  root["buffers"][0]["uri"] = "house.bin";
  write_text(f.in + "/house.gltf", root.dump());
  write_text(f.in + "/house.bin", glb.substr(28 + json_bytes));
  write_text(f.in + "/mesh.gltf", R"({"asset": {"version": "2.0"}, "meshes": [], "accessors": []})");
  const Batch run = convert_all(f.command());
  INFO(run.err);
  CHECK(run.exit_code == 0);
  CHECK(run.n_lines == 2);
  CHECK(run.lines.at("house.gltf")["status"] == "converted");
  CHECK(run.err.find("1 other file") != std::string::npos);
  // The program reads it alone, too, and keeps its buffer.
  CHECK(alone({f.in + "/house.gltf", f.file("one.rgs")}).exit_code == 0);
  CHECK(read_text(f.file("one.rgs")) == read_text(f.out + "/house.rgs"));
  CHECK(alone({f.in + "/house.gltf", f.in + "/house.bin", "--to", "ply", "--overwrite"}).exit_code == 2);
}

TEST_CASE("finished scenes are recognised by content, not by name or time") {
  const Folders f(4);
  REQUIRE(convert_all(f.command()).count("converted") == 4);
  const auto first = contents(f.out);
  const auto written = fs::last_write_time(f.out + "/a.rgs");
  const auto rerun = [&](std::vector<std::string> more = {}) {
    Batch run = convert_all(f.command(std::move(more)));
    INFO(run.err);
    CHECK(run.exit_code == 0);
    CHECK(run.n_lines == 4);
    return run;
  };
  const Batch second = rerun();
  CHECK(second.count("kept") == 4);
  CHECK(second.lines.at("a.ply")["output"]["gaussians"] == kSmall);  // the line repeats what it said then
  CHECK(fs::last_write_time(f.out + "/a.rgs") == written);

  // Other times, the same bytes.
  fs::last_write_time(f.in + "/a.ply", fs::file_time_type::clock::now());
  fs::copy_file(f.in + "/b.ply", f.in + "/b.new");
  fs::rename(f.in + "/b.new", f.in + "/b.ply");
  fs::last_write_time(f.out + "/c.rgs", fs::file_time_type::clock::now());
  CHECK(rerun({"--threads", "1", "--jobs", "3"}).count("kept") == 4);
  CHECK(contents(f.out) == first);

  // The same time and size, other bytes.
  const auto before = fs::last_write_time(f.in + "/d.ply");
  std::string bytes = read_text(f.in + "/d.ply");
  bytes[bytes.size() - 5] = static_cast<char>(bytes[bytes.size() - 5] ^ 1);
  wait_for_later_time(f.in + "/d.ply");
  write_text(f.in + "/d.ply", bytes);
  fs::last_write_time(f.in + "/d.ply", before);
  const Batch changed = rerun();
  CHECK(changed.count("converted") == 1);
  CHECK(changed.lines.at("d.ply")["status"] == "converted");
  CHECK(contents(f.out).at("d.rgs") != first.at("d.rgs"));

  // Missing outputs are made again; changed outputs belong to the user.
  const auto good = contents(f.out);
  fs::remove(f.out + "/a.rgs");
  fs::resize_file(f.out + "/b.rgs", 100);
  std::string changed_output = good.at("c.rgs");
  changed_output[200] = static_cast<char>(changed_output[200] ^ 1);
  wait_for_later_time(f.out + "/c.rgs");
  write_text(f.out + "/c.rgs", changed_output);
  const Batch refused = convert_all(f.command());
  CHECK(refused.exit_code == 3);
  CHECK(refused.count("converted") == 1);
  for (const char* name : {"b.ply", "c.ply"}) CHECK(refused.lines.at(name)["error"]["code"] == "output_exists");
  CHECK(contents(f.out).at("c.rgs") == changed_output);
  for (const char* name : {"/b.rgs", "/c.rgs"}) fs::remove(f.out + name);
  CHECK(rerun().count("converted") == 2);
  CHECK(contents(f.out) == good);

  // Other options, then the first ones: a conversion again, because the files are gone.
  CHECK(rerun({"--profile", "direct"}).count("converted") == 4);
  CHECK(rerun({"--profile", "direct"}).count("kept") == 4);
  CHECK(rerun().count("converted") == 4);
  CHECK(contents(f.out) == good);
  CHECK(rerun({"--overwrite"}).count("converted") == 4);
}

TEST_CASE("cameras are compared by content") {
  const Folders f(1);
  const auto cameras = [&](double z) {
    write_text(f.file("cameras.json"),
               R"([{"name":"a","width":96,"height":72,"fx":90,"fy":90,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,)" +
                   std::to_string(z) + "],[0,0,0,1]]}]");
  };
  cameras(30);
  const std::vector<std::string> command = f.command({"--cameras", f.file("cameras.json")});
  const Batch first = convert_all(command);
  INFO(first.err);
  CHECK(first.count("converted") == 1);
  CHECK(convert_all(command).count("kept") == 1);
  cameras(40);
  CHECK(convert_all(command).count("converted") == 1);
}

TEST_CASE("an output that was not made here stays unless --overwrite is given") {
  const Folders f(2);
  fs::create_directory(f.out);
  write_text(f.out + "/a.rgs", "mine");
  const Batch kept = convert_all(f.command());
  CHECK(kept.exit_code == 3);
  CHECK(kept.lines.at("a.ply")["error"]["code"] == "output_exists");
  CHECK(kept.lines.at("b.ply")["status"] == "converted");
  CHECK(read_text(f.out + "/a.rgs") == "mine");
  CHECK(convert_all(f.command()).exit_code == 3);
  CHECK(convert_all(f.command({"--overwrite"})).count("converted") == 2);
  CHECK(convert_all(f.command()).count("kept") == 2);
  // A file that appears after a failed conversion belongs to the user too.
  write_text(f.in + "/c.ply", "ply\nformat nonsense\n");
  CHECK(convert_all(f.command()).exit_code == 4);
  write_text(f.out + "/c.rgs", "mine");
  scene(f.in + "/c.ply", 7);
  CHECK(convert_all(f.command()).lines.at("c.ply")["error"]["code"] == "output_exists");
  CHECK(read_text(f.out + "/c.rgs") == "mine");
}

TEST_CASE("an output made from another input of the same name stays") {
  const Folders f(1);
  const std::string other = f.file("other"), copy = f.file("copy");
  scene(other + "/a.ply", 7);
  const Batch first = convert_all(f.command());
  REQUIRE(first.count("converted") == 1);
  const auto made = contents(f.out);
  for (int i = 0; i < 2; ++i) {
    const Batch second = convert_all({other, f.out, "--to", "rgs"});
    CHECK(second.exit_code == 3);
    CHECK(second.lines.at("a.ply")["error"]["code"] == "output_exists");
    CHECK(contents(f.out) == made);
  }
  // A copy of the input finds it finished, but does not own it.
  fs::copy(f.in, copy, fs::copy_options::recursive);
  CHECK(convert_all({copy, f.out, "--to", "rgs"}).count("kept") == 1);
  wait_for_later_time(copy + "/a.ply");
  scene(copy + "/a.ply", 8);
  CHECK(convert_all({copy, f.out, "--to", "rgs"}).lines.at("a.ply")["error"]["code"] == "output_exists");
  CHECK(contents(f.out) == made);
  // Converting the killed scene again does not make the file the other input's.
  const std::string state = f.out + "/.rgs-convert.jsonl";
  write_text(
      state,
      json{{"schema", "rgs-convert-state/1"}, {"output", "a.rgs"}, {"begun", true}, {"input_path", f.in + "/a.ply"}}
              .dump() +
          "\n");
  CHECK(convert_all({other, f.out, "--to", "rgs"}).lines.at("a.ply")["error"]["code"] == "output_exists");
  CHECK(convert_all(f.command()).count("converted") == 1);
  CHECK(convert_all({other, f.out, "--to", "rgs", "--overwrite"}).count("converted") == 1);
  CHECK(contents(f.out) != made);
  CHECK(convert_all(f.command()).lines.at("a.ply")["error"]["code"] == "output_exists");
}

TEST_CASE("scenes whose process cannot start fail, and the program ends") {
  if (kSanitized) return skip("sanitizers open files themselves");
  const Folders f(3);
  bool has_failed = false;
  for (rlim_t n_files = 4; n_files <= 9; ++n_files) {
    CAPTURE(n_files);
    Program run(program(f.command({"-q"})), [n_files] {
      const rlimit limit{n_files, n_files};
      ::setrlimit(RLIMIT_NOFILE, &limit);
    });
    const ProgramResult end = run.wait();
    has_failed = has_failed || end.out.find("cannot start a process for it") != end.out.npos;
  }
  CHECK(has_failed);
  // Scenes that never started belong to nobody.
  fs::remove_all(f.out + "/a.rgs");
  write_text(f.out + "/a.rgs", "mine");
  CHECK(convert_all(f.command()).lines.at("a.ply")["error"]["code"] == "output_exists");
}

TEST_CASE("a damaged scene stops no other, and the worst error decides the exit code") {
  const Folders f(5);
  write_text(f.in + "/b.ply", read_text(f.in + "/b.ply").substr(0, 5000));
  write_text(f.in + "/empty.spz", "");
  const Batch run = convert_all(f.command({"--jobs", "2"}));
  CHECK(run.exit_code == 4);
  CHECK(run.count("converted") == 4);
  CHECK(run.count("failed") == 2);
  const json& b = run.lines.at("b.ply");
  CHECK(b["exit_code"] == 4);
  CHECK(b["error"]["code"] == "truncated");
  CHECK(b["error"]["offset"] == 5000);
  CHECK(b["error"]["file"].get<std::string>().ends_with("b.ply"));
  CHECK(b["error"]["message"].get<std::string>().find("byte 5000") != std::string::npos);
  CHECK(run.lines.at("empty.spz")["exit_code"] == 4);
  CHECK(run.err.find("b.ply: byte 5000") != std::string::npos);
  CHECK(run.err.find("4 converted, 2 failed") != std::string::npos);
  // A dangling link is a scene that cannot be read, which is worse.
  fs::create_symlink("nowhere", f.in + "/gone.ply");
  fs::create_symlink("nowhere", f.in + "/gone.txt");
  const Batch worse = convert_all(f.command());
  CHECK(worse.exit_code == 3);
  CHECK(worse.lines.at("gone.ply")["error"]["code"] == "open_failed");
  CHECK(worse.count("kept") == 4);
  // Repaired, it is converted; everything else is kept.
  scene(f.in + "/b.ply", 1);
  CHECK(convert_all(f.command()).lines.at("b.ply")["status"] == "converted");
  // On request, nothing starts after the first failure.
  fs::remove(f.in + "/gone.ply");
  const Batch first = convert_all({f.in, f.file("other"), "--to", "rgs", "--no-keep-going", "--jobs", "1"});
  CHECK(first.exit_code == 4);
  CHECK(first.count("failed") == 1);
  const Folders g(3);
  write_text(g.in + "/a.ply", read_text(g.in + "/a.ply").substr(0, 5000));
  const Batch stopped = convert_all(g.command({"--no-keep-going"}));
  CHECK(stopped.n_lines == 1);
  CHECK(stopped.err.find("2 not begun") != std::string::npos);
  CHECK(convert_all(g.command({"--keep-going"})).count("converted") == 2);
  // The same if one fails before there is work.
  const Folders h(2);
  fs::create_symlink("nowhere", h.in + "/gone.ply");
  const Batch none = convert_all(h.command({"--no-keep-going"}));
  CHECK(none.count("converted") == 0);
  CHECK(none.err.find("2 not begun") != std::string::npos);
}

TEST_CASE("an unreadable input is reported and stops no other") {
  const Folders f(3);
  const std::string program = f.file("rgs-convert");
  fs::copy_file(built("rgs-convert"), program);  // a path that the other user can reach
  scene(f.in + "/locked/x.ply", 8);
  fs::create_directory(f.out);
  fs::permissions(f.in + "/b.ply", fs::perms(0));
  fs::permissions(f.in + "/locked", fs::perms(0));
  fs::permissions(f.out, fs::perms(0777));
  fs::permissions(f.path(), fs::perms(0755));
  const bool root = ::geteuid() == 0;
  ProgramResult run = run_program({program, "--no-sync", f.in, f.out, "--to", "rgs"}, [root] {
    constexpr unsigned kNobody = 65534;
    if (root && (::setgid(kNobody) != 0 || ::setuid(kNobody) != 0)) ::_exit(126);
  });
  fs::permissions(f.in + "/locked", fs::perms(0755));
  if (run.exit_code == 126) return skip("root cannot become another user here");
  const std::string text = run.out;
  const Batch batch = lines_of(std::move(run), text);
  CHECK(batch.exit_code == 3);
  CHECK(batch.count("converted") == 2);
  CHECK(batch.lines.at("b.ply")["error"]["message"].get<std::string>().find("Permission denied") != std::string::npos);
  CHECK(batch.lines.at("locked")["exit_code"] == 3);
}

TEST_CASE("scenes with the same output are named before anything is written") {
  const Folders f(1);
  fs::copy_file(f.in + "/a.ply", f.in + "/a.compressed.ply");
  for (const std::vector<std::string>& more : {std::vector<std::string>{}, {"--shard", "1/2"}, {"--shard", "2/2"}}) {
    const Batch run = convert_all(f.command(more));
    CHECK(run.exit_code == 2);
    CHECK(run.err.find("a.compressed.ply and a.ply would both become a.rgs") != std::string::npos);
    CHECK_FALSE(fs::exists(f.out));
  }
}

TEST_CASE("links, hidden files, unfinished outputs and a folder of outputs among the inputs") {
  const Folders f(2);
  const std::string inside = f.in + "/converted";
  scene(f.file("elsewhere/x.ply"), 5);
  fs::create_symlink("../elsewhere/x.ply", f.in + "/link.ply");
  fs::create_directory_symlink("../elsewhere", f.in + "/folder");
  fs::create_directory_symlink(".", f.in + "/self");
  scene(f.in + "/.hidden.ply", 6);
  scene(f.in + "/.cache/x.ply", 6);
  fs::copy_file(f.in + "/a.ply", f.in + "/a.rgs.tmp-AbCdEf");
  REQUIRE(::mkfifo((f.in + "/pipe.ply").c_str(), 0600) == 0);
  const std::vector<std::string> command{f.in, inside, "--to", "rgs"};
  const Batch run = convert_all(command);
  INFO(run.err);
  CHECK(run.exit_code == 0);
  CHECK(names(contents(inside)) == std::set<std::string>{"a.rgs", "b.rgs", "folder/x.rgs", "link.rgs"});
  CHECK(run.err.find("self: a link to a folder that contains it") != std::string::npos);
  CHECK(convert_all(command).count("kept") == 4);  // and no output became an input
  // Not onto itself, by whatever name.
  for (const std::string& same : {f.in, f.in + "/.", f.in + "/self", f.file("elsewhere/../in")})
    CHECK(convert_all({f.in, same, "--to", "rgs"}).exit_code == 2);
  // Nor an output onto an input.
  const Folders g(1);
  REQUIRE(convert_all(g.command()).exit_code == 0);
  fs::create_directory(g.out + "/sub");
  fs::copy_file(g.in + "/a.ply", g.out + "/sub/a.ply");
  fs::create_symlink("../in/a.ply", g.file("out/b.rgs"));
  scene(g.in + "/b.ply", 3);
  const Batch clash = convert_all(g.command({"--overwrite"}));
  CHECK(clash.exit_code == 2);
  CHECK(clash.err.find("is the same file as input") != std::string::npos);
}

TEST_CASE("a list names inputs, and outputs after a tab") {
  const Folders f(3);
  const std::string list = f.file("list.txt");
  write_text(f.in + "/README.md", "no scene");
  write_text(list, "a.ply\r\n\nb.ply\tsub/other.rgs\nREADME.md\nmissing.ply");
  const Batch run = convert_all(f.command({"--list", list}));
  INFO(run.err);
  CHECK(run.exit_code == 3);
  CHECK(names(contents(f.out)) == std::set<std::string>{"a.rgs", "sub/other.rgs"});
  CHECK(run.n_lines == 4);
  CHECK(run.lines.at("README.md")["exit_code"] == 4);
  CHECK(run.lines.at("missing.ply")["exit_code"] == 3);
  CHECK(convert_all(f.command({"--list", list})).count("kept") == 2);
  // Relative to the working folder, through a pipe; paths outside lose their folders.
  const ProgramResult piped = run_shell("cd '" + f.path().string() + "' && ls in/*.ply | '" + built("rgs-convert") +
                                        "' --no-sync -q --list - piped --to spz && echo \"$PWD/in/a.ply\" > one && '" +
                                        built("rgs-convert") + "' --no-sync -q --list one absolute --to ply");
  CHECK(piped.exit_code == 0);
  CHECK(names(contents(f.file("piped"))) == std::set<std::string>{"in/a.spz", "in/b.spz", "in/c.spz"});
  CHECK(names(contents(f.file("absolute"))) == std::set<std::string>{"a.ply"});
  // Formats by name if --to does not name them.
  write_text(list, "a.ply\tx.spz\nb.ply\ty.rgs\n");
  CHECK(convert_all({"--list", list, f.in, f.file("mixed")}).count("converted") == 2);
  CHECK(read_text(f.file("mixed/y.rgs")).substr(1, 3) == "RGS");
  for (const std::string text : {"a.ply\tx.rgs\nb.ply\t./x.rgs\n", "a.ply\tx\ty\n", "\tx\n", "a.ply\t\n", "a.ply\n", "",
                                 "a.ply\tx.nothing\n", "a.ply\tx.pt\n"}) {
    CAPTURE(text);
    write_text(list, text);
    CHECK(convert_all({"--list", list, f.in, f.file("none")}).exit_code == 2);
    CHECK_FALSE(fs::exists(f.file("none")));
  }
  CHECK(convert_all({"--list", list, f.in + "/a.ply", f.file("none"), "--to", "rgs"}).exit_code == 2);
  CHECK(convert_all({"--list", f.file("absent"), f.in, f.file("none")}).exit_code == 3);
}

TEST_CASE("options that do not suit many scenes are refused") {
  const Folders f(1);
  CHECK(convert_all({f.in, f.out}).exit_code == 2);
  CHECK(convert_all({f.in, f.out, "--to", "pt"}).exit_code == 2);
  for (const std::vector<std::string>& more : {std::vector<std::string>{"--merge"},
                                               {"--audit"},
                                               {"--shard", "0/2"},
                                               {"--shard", "3/2"},
                                               {"--shard", "1"},
                                               {"--shard", "1/2x"},
                                               {"--jobs", "0"},
                                               {"--axes", "north"},
                                               {"--memory", "1GB"},
                                               {"--crop", "1"},
                                               {"--translate", "1,2,3", "--translate", "1,2,3"},
                                               {"--lod", "--memory", "256MiB", "--jobs", "3"}}) {
    CAPTURE(more.front());
    CHECK(convert_all(f.command(more)).exit_code == 2);
  }
  CHECK(convert_all({f.in, f.out, "--to", "spz", "--profile", "direct"}).exit_code == 2);
  CHECK(convert_all({f.in + "/a.ply", f.file("a.rgs"), "--jobs", "2"}).exit_code == 2);
  CHECK(convert_all({f.in + "/a.ply"}).exit_code == 2);
  CHECK(convert_all({f.in, "--to", "rgs"}).exit_code == 2);
  CHECK_FALSE(fs::exists(f.out));
  fs::create_directory(f.file("nothing"));
  CHECK(convert_all({f.file("nothing"), f.out, "--to", "rgs"}).exit_code == 2);
  write_text(f.file("file"), "");
  CHECK(convert_all({f.in, f.file("file"), "--to", "rgs"}).exit_code == 3);
}

TEST_CASE("levels of detail share the memory limit among processes") {
  const Folders f(2, 3000);
  const Batch run = convert_all(f.command({"--lod", "--memory", "256MiB", "--jobs", "2"}));
  INFO(run.err);
  CHECK(run.count("converted") == 2);
  CHECK(run.lines.at("a.ply")["levels"]["levels"].get<int>() > 1);
  const std::string single = f.file("single.rgs");
  REQUIRE(run_program({built("rgs-convert"), "-q", "--no-sync", "--lod", f.in + "/a.ply", single}).exit_code == 0);
  CHECK(read_text(single) == contents(f.out).at("a.rgs"));
  CHECK(entries(f.out) == 3);  // and no scratch files
}

TEST_CASE("shards convert every scene exactly once, concurrently into one folder") {
  const Folders f;
  for (int i = 0; i < 13; ++i)
    scene(f.in + "/s" + std::to_string(i) + ".ply", 1, kSmall * static_cast<std::uint64_t>(1 + i * i));
  std::vector<std::unique_ptr<Program>> shards;
  for (const char* shard : {"1/4", "2/4", "3/4", "4/4"})
    shards.push_back(std::make_unique<Program>(program(f.command({"--shard", shard, "-q"}))));
  std::set<std::string> seen;
  std::vector<std::uint64_t> bytes;
  for (auto& shard : shards) {
    ProgramResult run = shard->wait();
    CHECK(run.exit_code == 0);
    const std::string text = run.out;
    const Batch batch = lines_of(std::move(run), text);
    bytes.push_back(0);
    for (const auto& [name, line] : batch.lines) {
      const std::string& input = name;
      CHECK_MESSAGE(seen.insert(input).second, input);
      CHECK(line["status"] == "converted");
      bytes.back() += line["source"]["bytes"].get<std::uint64_t>();
    }
  }
  CHECK(seen.size() == 13);
  // A shard has at least the largest scene.
  CHECK(*std::ranges::max_element(bytes) < 2 * *std::ranges::min_element(bytes));
  const Batch all = convert_all(f.command());
  CHECK(all.count("kept") == 13);
  CHECK(convert_all(f.command({"--shard", "2/3"})).count("converted") == 0);
  // More shards than scenes: some have no work.
  CHECK(convert_all(f.command({"--shard", "40/40"})).exit_code == 0);
}

TEST_CASE("of two programs on one folder the second is refused") {
  const Folders f(1);
  Program first(program(f.command({"-q"})), failpoint("scenes"));
  REQUIRE(first.stops());
  const Batch second = convert_all(f.command());
  CHECK(second.exit_code == 3);
  CHECK(second.err.find("another rgs-convert is working on this folder") != std::string::npos);
  first.send(SIGCONT);
  CHECK(first.wait().exit_code == 0);
}

TEST_CASE("a report has a line for each scene, in order, and replaces only reports") {
  const Folders f(3);
  const std::string report = f.file("report.jsonl");
  const Batch quiet = convert_all(f.command({"--report", report, "--jobs", "3"}));
  CHECK(quiet.out.empty());
  CHECK(quiet.exit_code == 0);
  std::istringstream lines(read_text(report));
  for (const char* name : {"a.ply", "b.ply", "c.ply"}) {
    std::string line;
    REQUIRE(std::getline(lines, line));
    CHECK(json::parse(line)["input_path"] == name);
  }
  CHECK(convert_all(f.command({"--report", report})).exit_code == 0);  // the folder continues, and so does its report
  CHECK(read_text(report).find("\"kept\"") != std::string::npos);
  write_text(report, "mine");
  CHECK(convert_all(f.command({"--report", report})).exit_code == 3);
  CHECK(read_text(report) == "mine");
  CHECK(convert_all(f.command({"--report", report, "--overwrite"})).exit_code == 0);
  CHECK(convert_all(f.command({"--report", f.in + "/a.ply"})).exit_code == 2);
  CHECK(convert_all(f.command({"--report", f.file("no/report")})).exit_code == 3);
  // The folder of outputs is created first; its state is no report.
  const std::string fresh = f.file("fresh"), state = fresh + "/.rgs-convert.jsonl";
  CHECK(convert_all({f.in, fresh, "--to", "rgs", "--report", state}).exit_code == 2);
  CHECK_FALSE(fs::exists(fresh));
  CHECK(convert_all({f.in, fresh, "--to", "rgs", "--report", fresh + "/report.jsonl"}).exit_code == 0);
  CHECK(read_text(fresh + "/report.jsonl").find("\"converted\"") != std::string::npos);
  const std::string before = read_text(state);
  CHECK(convert_all({f.in, fresh, "--to", "rgs", "--report", state, "--overwrite"}).exit_code == 2);
  CHECK(convert_all({f.in, fresh, "--to", "rgs", "--report", state, "--shard", "1/2", "--overwrite"}).exit_code == 2);
  CHECK(read_text(state) == before);
}

TEST_CASE("killed after any number of scenes, the rerun does only the missing ones") {
  constexpr std::size_t kScenes = 6;
  const Folders f(kScenes, 5000);
  const std::string whole = f.file("whole");
  REQUIRE(convert_all({f.in, whole, "--to", "rgs"}).count("converted") == kScenes);
  const std::uintmax_t bytes = fs::file_size(f.in + "/a.ply");  // of each
  for (std::size_t n_done = 0; n_done <= kScenes; ++n_done) {
    CAPTURE(n_done);
    fs::remove_all(f.out);
    {
      // Children end with their parent, and hold the pipe until then.
      int ends[2];
      REQUIRE(::pipe(ends) == 0);
      Program run(program(f.command({"--jobs", "2", "--level", "5", "-q"})),
                  failpoint("scenes", bytes * n_done, SIGKILL));
      ::close(ends[1]);
      CHECK(run.wait().signal == SIGKILL);
      char none = 0;
      CHECK(::read(ends[0], &none, 1) == 0);
      ::close(ends[0]);
    }
    std::set<std::string> done;
    std::istringstream lines(read_text(f.out + "/.rgs-convert.jsonl"));
    for (std::string line; std::getline(lines, line);) {
      const json j = json::parse(line, nullptr, false);
      if (j.is_object() && j.contains("made")) done.insert(j["output"]);
    }
    CHECK(done.size() == n_done);
    CHECK_FALSE(has_temporaries(f.out));
    const Batch rest = convert_all(f.command({"--level", "5"}));
    INFO(rest.err);
    CHECK(rest.exit_code == 0);
    CHECK(rest.count("kept") == n_done);
    CHECK(rest.count("converted") == kScenes - n_done);
    for (const std::string& output : done) CHECK(rest.lines.at(output.substr(0, 1) + ".ply")["status"] == "kept");
  }
  // As if never interrupted.
  CHECK(convert_all(f.command({"--level", "1"})).exit_code == 0);
  CHECK(convert_all(f.command()).exit_code == 0);
  CHECK(contents(f.out) == contents(whole));
}

TEST_CASE("a streamed SOG is one scene, and its parts are none") {
  const Folders f(1);
  for (const char* name : {"/tree/0_0/meta.json", "/tree/1_0/meta.json"}) {
    fs::create_directories(fs::path(f.in + name).parent_path());
    write_text(f.in + name, R"({"version": 2, "count": 3, "means": {}})");
  }
  write_text(f.in + "/tree/lod-meta.json", R"({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"]})");
  const Batch damaged = convert_all(f.command());
  CHECK(damaged.exit_code == 4);
  CHECK(damaged.n_lines == 2);
  CHECK(damaged.lines.at("a.ply")["status"] == "converted");
  CHECK(damaged.lines.at("tree/lod-meta.json")["error"]["code"] == "bad_syntax");
  const std::string levels = f.file("levels.rgs");
  REQUIRE(run_program({built("rgs-convert"), "--lod", f.in + "/a.ply", levels}).exit_code == 0);
  REQUIRE(run_program({built("rgs-convert"), "--overwrite", levels, f.in + "/tree/lod-meta.json"}).exit_code == 0);
  const Batch run = convert_all(f.command());
  CHECK(run.exit_code == 0);
  CHECK(run.n_lines == 2);
  CHECK(run.lines.at("tree/lod-meta.json")["status"] == "converted");
  CHECK(fs::exists(f.out + "/tree/lod-meta.rgs"));
  // Others beside it and in other folders are scenes too.
  fs::create_directories(f.in + "/tree/more");
  for (const char* name : {"/tree/b.ply", "/tree/more/c.ply"}) fs::copy_file(f.in + "/a.ply", f.in + name);
  const Batch more = convert_all(f.command());
  CHECK(more.exit_code == 0);
  CHECK(more.n_lines == 4);
  for (const char* name : {"tree/b.ply", "tree/more/c.ply"}) CHECK(more.lines.at(name)["status"] == "converted");
  // So is a SOG that it does not name.
  fs::create_directories(f.in + "/tree/castle");
  write_text(f.in + "/tree/castle/meta.json", R"({"version": 2, "count": 3, "means": {}})");
  CHECK(convert_all(f.command()).lines.contains("tree/castle/meta.json"));
  fs::remove_all(f.in + "/tree/castle");
  // Another file of that name is no scene.
  write_text(f.in + "/tree/lod-meta.json", "{}");
  CHECK(convert_all(f.command()).n_lines == 5);
}

TEST_CASE("a tileset is one scene, and its tiles are none") {
  const Folders f(1);
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", f.in + "/a.ply", f.in + "/tree/tileset.json"}).exit_code ==
          0);
  const Batch run = convert_all(f.command());
  CHECK(run.exit_code == 0);
  CHECK(run.n_lines == 2);
  CHECK(run.lines.at("tree/tileset.json")["status"] == "converted");
  CHECK(fs::exists(f.out + "/tree/tileset.rgs"));
  // Others beside and below it are scenes too.
  for (const char* name : {"/tree/b.ply", "/tree/tiles/c.ply"}) fs::copy_file(f.in + "/a.ply", f.in + name);
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", f.in + "/a.ply", f.in + "/tree/d.tileset.json"}).exit_code ==
          0);
  const Batch more = convert_all(f.command());
  CHECK(more.exit_code == 0);
  CHECK(more.n_lines == 5);
  for (const char* name : {"tree/b.ply", "tree/tiles/c.ply", "tree/d.tileset.json"})
    CHECK(more.lines.at(name)["status"] == "converted");
  CHECK(run_program({built("rgs-convert"), "--to", "tileset.json", f.in, f.out}).exit_code == 2);
  // Whatever its name, and also if another names it.
  fs::rename(f.in + "/tree/d.tileset.json", f.in + "/tree/d.json");
  CHECK(convert_all(f.command()).n_lines == 5);
  write_text(f.in + "/tree/e.json", R"({"asset": {"version": "1.1"}, "geometricError": 9,
                                        "root": {"content": {"uri": "d.json"}}})");
  const Batch named = convert_all(f.command());
  CHECK(named.n_lines == 5);
  CHECK(named.lines.at("tree/e.json")["status"] == "converted");
  CHECK_FALSE(named.lines.contains("tree/d.json"));
}

TEST_CASE("tilesets of one folder have folders of their own") {
  std::set<std::string> folders;
  const std::vector<std::string> names{"tileset", "tiles", "tiles_", "tiles__", "a:b", "a_b", "a\\b", "a~b", "a~cb",
                                       "a~bb",    "~",     "~~",     "~.",      "",    ".",   "..",   "...", "b"};
  for (const std::string& name : names) {
    const std::string folder = folder_of_tiles("x/" + name + ".json");
    CAPTURE(name);
    CHECK(folders.insert(folder).second);
    CHECK(folder.find_first_of("/\\:") == folder.npos);
    CHECK(folder.find_first_not_of('.') != folder.npos);
  }
  CHECK(folders.contains("tiles"));
  CHECK(folders.contains("b"));
}

TEST_CASE("the chunks of an LCC2 are no scenes of their own") {
  const Folders f(1);
  fs::create_directories(f.in + "/b/data/3dgs");
  write_text(f.in + "/b/b.lcc2", R"({"totalLevels": 1, "lodSplats": [1], "root": {"splatFiles": ["data/3dgs/0.sog"],
             "child": [{"data": {"3dgs": {"name": 0}}}]}})");
  const std::string sog = f.in + "/b/data/3dgs/0.sog";
  REQUIRE(run_program({built("rgs-convert"), "--no-sync", f.in + "/a.ply", sog}).exit_code == 0);
  const Batch run = convert_all(f.command());
  CHECK(run.exit_code == 0);
  CHECK(run.n_lines == 2);
  CHECK(run.lines.at("b/b.lcc2")["status"] == "converted");
  CHECK(fs::exists(f.out + "/b/b.rgs"));
  // A folder of that name that it does not name.
  write_text(f.in + "/b/b.lcc2", R"({"totalLevels": 1, "lodSplats": [1], "root": {"splatFiles": ["0.sog"]}})");
  CHECK(convert_all(f.command()).n_lines == 3);
}

TEST_CASE("--overwrite-damaged replaces the outputs that are damaged, says so, and touches no other") {
  const Folders f(5);
  const auto again = [&](const std::vector<std::string>& more) {
    std::vector<std::string> options{"--lod"};
    options.insert(options.end(), more.begin(), more.end());
    return convert_all(f.command(options));
  };
  REQUIRE(again({}).count("converted") == 5);
  const auto whole = contents(f.out);
  // A prefix, a flipped bit in an upper page, and an empty file; d is a scene of another maker.
  fs::resize_file(f.out + "/a.rgs", whole.at("a.rgs").size() / 2);
  std::string flipped = whole.at("b.rgs");
  flipped[flipped.size() / 2] = static_cast<char>(flipped[flipped.size() / 2] ^ 1);
  write_text(f.out + "/b.rgs", flipped);
  write_text(f.out + "/c.rgs", "");
  write_text(f.out + "/d.rgs", whole.at("a.rgs"));
  REQUIRE(again({}).count("failed") == 4);  // as ever: they changed since they were made
  const Batch run = again({"--overwrite-damaged"});
  INFO(run.err);
  CHECK(run.exit_code == 3);
  for (const char* name : {"a", "b", "c"}) {
    CAPTURE(std::string(name));
    CHECK(run.lines.at(name + std::string(".ply"))["status"] == "converted");
    CHECK(run.lines.at(name + std::string(".ply"))["damaged_output"]["file"] == f.out + "/" + name + ".rgs");
    CHECK(read_text(f.out + "/" + name + ".rgs") == whole.at(name + std::string(".rgs")));
  }
  CHECK(run.lines.at("c.ply")["damaged_output"]["message"].get<std::string>().find("empty") != std::string::npos);
  CHECK(run.lines.at("d.ply")["error"]["code"] == "output_exists");
  CHECK(run.lines.at("e.ply")["status"] == "kept");
  CHECK(run.err.find("3 of them in place of damaged outputs") != std::string::npos);
  fs::remove(f.out + "/d.rgs");
  CHECK(again({"--overwrite-damaged"}).count("converted") == 1);
  const Batch rest = again({"--overwrite-damaged"});
  CHECK(rest.count("kept") == 5);
  CHECK(rest.err.find("damaged") == std::string::npos);
  CHECK(contents(f.out) == whole);
  CHECK(convert_all({f.in + "/a.ply", f.file("one.rgs"), "--overwrite-damaged"}).exit_code == 2);
}

TEST_CASE("the rerun removes unfinished files of a killed process") {
  const Folders f(2);
  REQUIRE(convert_all(f.command()).exit_code == 0);
  fs::remove(f.out + "/a.rgs");
  const std::string state = f.out + "/.rgs-convert.jsonl", other = f.out + "/.rgs-convert-1-of-2.jsonl";
  const std::string made = read_text(state);
  write_text(f.out + "/a.rgs.tmp-abcde5", "half");
  write_text(f.out + "/mine.tmp-abcde5", "not ours");
  for (const char* name : {"/a.rgs.tmp-AbCdEf", "/a.rgs.tmp-abcdef.gz", "/b.rgs.tmp-backup"})
    write_text(f.out + name, "not ours");
  const auto before = names(contents(f.out));
  const auto begin = [&](const std::string& path, const std::string& earlier) {
    write_text(path, earlier +
                         json{{"schema", "rgs-convert-state/1"},
                              {"output", "a.rgs"},
                              {"begun", true},
                              {"input_path", f.in + "/a.ply"}}
                             .dump() +
                         "\n");
  };
  // Nothing started: the owner is unknown, and --overwrite concerns outputs.
  CHECK(convert_all(f.command({"--overwrite"})).count("converted") == 2);
  auto after = before;
  after.insert("a.rgs");
  CHECK(names(contents(f.out)) == after);
  // Started by a shard that is still running.
  fs::remove(f.out + "/a.rgs");
  begin(other, "");
  {
    const int fd = ::open(other.c_str(), O_RDWR | O_CLOEXEC);
    REQUIRE(fd >= 0);
    struct flock lock {};
    lock.l_type = F_WRLCK;
    lock.l_whence = SEEK_SET;
    REQUIRE(::fcntl(fd, F_SETLK, &lock) == 0);
    CHECK(convert_all(f.command()).count("converted") == 1);
    ::close(fd);
  }
  CHECK(names(contents(f.out)) == after);
  // Started by one that is gone.
  fs::remove(f.out + "/a.rgs");
  CHECK(convert_all(f.command()).count("converted") == 1);
  after.erase("a.rgs.tmp-abcde5");
  CHECK(names(contents(f.out)) == after);
}

TEST_CASE("one shard's state does not end another's work, in whatever order the states are read") {
  for (const auto& [begun, ended] : {std::pair("1-of-2", "2-of-2"), std::pair("2-of-2", "1-of-2")}) {
    const Folders f(1);
    fs::create_directory(f.out);
    const auto write = [&](const char* shard, bool is_begun) {
      write_text(f.out + "/.rgs-convert-" + shard + ".jsonl", json{{"schema", "rgs-convert-state/1"},
                                                                   {"output", "a.rgs"},
                                                                   {"begun", is_begun},
                                                                   {"input_path", f.in + "/a.ply"}}
                                                                      .dump() +
                                                                  "\n");
    };
    write(begun, true);
    write(ended, false);
    write_text(f.out + "/a.rgs", "what was killed has left");
    CHECK(convert_all(f.command()).count("converted") == 1);
  }
}

TEST_CASE("on a terminal --quiet prints no lines") {
  const Folders f(1);
  if (run_shell("command -v script").exit_code != 0) return skip("`script` is not installed (Debian: bsdutils)");
  const auto on_terminal = [&](const std::string& more) {
    fs::remove_all(f.out);
    return run_shell("script -qec '" + built("rgs-convert") + " --no-sync " + f.in + " " + f.out + " --to rgs " + more +
                     " 2>/dev/null' /dev/null")
        .out;
  };
  CHECK(on_terminal("-q").empty());
  CHECK(on_terminal("").find("a.ply -> a.rgs: converted") != std::string::npos);
  CHECK(on_terminal("-q --json").find("\"schema\"") != std::string::npos);
}

TEST_CASE("a truncated or damaged state costs only the lines that are lost") {
  const Folders f(3);
  REQUIRE(convert_all(f.command()).exit_code == 0);
  const std::string path = f.out + "/.rgs-convert.jsonl", state = read_text(path);
  for (std::size_t cut = state.size() - 1; cut > 0; cut = cut * 3 / 4) {
    CAPTURE(cut);
    write_text(path, state.substr(0, cut));
    // An output without a line does not count as ours.
    const Batch run = convert_all(f.command());
    CHECK(run.n_lines == 3);
    CHECK(run.count("kept") + run.count("converted") + run.count("failed") == 3);
    for (const auto& [input, line] : run.lines)
      if (line["status"] == "failed") CHECK(line["error"]["code"] == "output_exists");
    CHECK(convert_all(f.command()).count("converted") == 0);
  }
  write_text(path, "no JSON\n{}\n[1]\n{\"schema\":\"rgs-convert-state/1\",\"output\":7}\n" + state + "half a li");
  CHECK(convert_all(f.command()).count("kept") == 3);
}

TEST_CASE("signals end all conversions, and leave no partial output and no damaged state") {
  for (const int signal_number : {SIGTERM, SIGINT, SIGHUP}) {
    CAPTURE(signal_number);
    const Folders f(4);
    Program run(program(f.command({"--jobs", "2"})), failpoint("encode"));  // each child stops there
    while (!has_stopped_child(run.id()) && run.running()) std::this_thread::yield();
    run.send(signal_number);
    const ProgramResult end = run.wait();
    CHECK(end.signal == signal_number);
    CHECK(end.err.find("run the same command to continue") != std::string::npos);
    CHECK_FALSE(has_temporaries(f.out));
    const Batch rest = convert_all(f.command({"--jobs", "2"}));
    CHECK(rest.exit_code == 0);
    CHECK(rest.count("converted") == 4);
  }
}

TEST_CASE("a conversion whose process is killed is reported, and the others continue") {
  const Folders f(2);
  scene(f.in + "/large.ply", 3, 2 * kSmall);
  const Batch batch = convert_all(f.command(), failpoint("scan", 2 * kSmall, SIGKILL));
  CHECK(batch.exit_code == 3);
  CHECK(batch.lines.at("large.ply")["error"]["message"].get<std::string>().find("signal 9") != std::string::npos);
  CHECK(batch.count("converted") == 2);
  CHECK(convert_all(f.command()).count("kept") == 2);
}

TEST_CASE("a limit of file sizes fails only the scenes that exceed it") {
  const Folders f(2);
  scene(f.in + "/large.ply", 3, 20'000);
  const Batch run = convert_all(f.command(), [] {
    const rlimit limit{1 << 17, 1 << 17};
    ::setrlimit(RLIMIT_FSIZE, &limit);
  });
  CHECK(run.exit_code == 3);
  CHECK(run.count("converted") == 2);
  CHECK(run.lines.at("large.ply")["error"]["message"].get<std::string>().find("File too large") != std::string::npos);
  CHECK(names(contents(f.out)) == std::set<std::string>{"a.rgs", "b.rgs"});
  CHECK(convert_all(f.command()).count("kept") == 2);
}

TEST_CASE("a full disk fails the scenes without room, and the rerun continues from there") {
  const Folders f(12, 5000);
  fs::create_directory(f.out);
  if (::mount("tmpfs", f.out.c_str(), "tmpfs", 0, "size=1m") != 0)
    return skip("a small file system cannot be mounted here (needs root)");
  struct Unmount {
    const std::string& disk;
    ~Unmount() { ::umount2(disk.c_str(), MNT_DETACH); }
  } const unmount{f.out};
  const Batch full = convert_all(f.command({"--jobs", "2"}));
  CHECK(full.exit_code == 3);
  CHECK(full.count("converted") > 0);
  CHECK(full.count("failed") > 0);
  CHECK(full.err.find("No space left on device") != std::string::npos);
  CHECK_FALSE(has_temporaries(f.out));
  REQUIRE(::mount("tmpfs", f.out.c_str(), "tmpfs", MS_REMOUNT, "size=16m") == 0);
  const Batch rest = convert_all(f.command());
  CHECK(rest.exit_code == 0);
  CHECK(rest.count("kept") <= full.count("converted"));
  CHECK(rest.count("kept") + rest.count("converted") == 12);
}

TEST_CASE("names that are not UTF-8 stay distinct") {
  const Folders f;
  scene(f.in + "/\xfe.ply", 1);
  scene(f.in + "/\xff.ply", 2);
  scene(f.in + "/new\nline.ply", 3);
  REQUIRE(convert_all(f.command()).exit_code == 0);
  const Batch run = convert_all(f.command());
  CHECK(run.n_lines == 3);
  CHECK(run.out.find("converted") == std::string::npos);
}
