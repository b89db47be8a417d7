// parts_program_test.cpp - rgs-convert --lod-partition, --lod-build, --lod-assemble and --lod-list on the command line.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "convert_program.hpp"
#include "convert_scenes.hpp"
#include "edit_file.hpp"
#include "interchange_samples.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

ProgramResult program(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), {built("rgs-convert"), "--no-sync"});
  return run_program(arguments);
}

std::vector<std::string> joined(std::vector<std::string> words, const std::vector<std::string>& more) {
  words.insert(words.end(), more.begin(), more.end());
  return words;
}

// Two PLY files, one of them damaged, and an SPZ.
std::vector<std::string> three_inputs(const TemporaryFolder& folder) {
  const std::string a = write_scene(folder.file("a.ply"), ordinary_cloud(2000, 1, 1)),
                    b = write_scene(folder.file("b.ply"), damaged(ordinary_cloud(1500, 2, 2), 700)),
                    c = folder.file("c.spz");
  REQUIRE(rgs_convert({write_scene(folder.file("c.ply"), ordinary_cloud(1200, 1, 3)), c}).exit_code == 0);
  return {a, b, c};
}

void check_same(const TemporaryFolder& folder, const std::vector<std::string>& inputs,
                const std::vector<std::string>& options) {
  CAPTURE(options);
  const std::string work = folder.file("work"), whole = folder.file("whole.rgs"), parts = folder.file("parts.rgs");
  const ProgramResult one = rgs_convert(joined(joined({"--lod", "--merge"}, options), joined(inputs, {whole})));
  CAPTURE(one.err);
  REQUIRE(one.exit_code == 0);
  const ProgramResult begun = rgs_convert(joined(joined({"--lod-partition", work, "--ranges", "2"}, options), inputs));
  CAPTURE(begun.err);
  REQUIRE(begun.exit_code == 0);
  REQUIRE(program({"--lod-build", work}).exit_code == 0);
  const ProgramResult assembled = program({"--lod-assemble", work, parts, "--overwrite"});
  CAPTURE(assembled.err);
  REQUIRE(assembled.exit_code == 0);
  CHECK(assembled.out.find("  levels ") != std::string::npos);
  CHECK(read_bytes(parts) == read_bytes(whole));
}

}  // namespace

TEST_CASE("parts by the program have the bytes of --lod, whatever the inputs and options") {
  const TemporaryFolder folder;
  const std::vector<std::string> inputs = three_inputs(folder);
  const std::string cameras = folder.file("cameras.json");
  write_text(cameras, R"([{"id":0,"img_name":"a","width":640,"height":480,"position":[0,0,-4],)"
                      R"("rotation":[[1,0,0],[0,1,0],[0,0,1]],"fx":500,"fy":500}])");
  check_same(folder, inputs, {"--on-bad", "drop", "--profile", "direct"});
  check_same(folder, inputs,
             {"--on-bad", "repair", "--keep-permutation", "--cameras", cameras, "--sh-degree", "1", "--aa", "mip"});
  check_same(folder, inputs,
             {"--on-bad", "drop", "--translate", "4000000,0,5", "--translate", "0,1,0", "--translate", "4000000,2,2",
              "--rotate", "0,90,0", "--scale", "2", "--file-scales", "--near", "0.5", "--allow-rounding"});
  // Far apart: pages have origins of their own, which archives do not.
  const std::vector<std::string> apart{"--on-bad",    "drop",  "--translate", "4000000,0,5",
                                       "--translate", "0,1,0", "--translate", "4000000,2,2"};
  check_same(folder, inputs, apart);
  const ProgramResult far =
      rgs_convert({"--lod-partition", folder.file("far"), "--ranges", "2", "--profile", "archive:small", "--translate",
                   "4000000,0,5", "--translate", "0,1,0", inputs[0], inputs[2]});
  CHECK(far.exit_code == 4);
  CHECK(far.err.find("pass --allow-rounding") != std::string::npos);
  check_same(folder, inputs, {"--on-bad", "drop", "--profile", "archive:small", "--keep-permutation"});
  check_same(folder, {inputs[2]}, {"--to-axes", "opengl", "--profile", "archive", "--archive-step", "3.3"});
  check_same(folder, {inputs[0]}, {"--axes", "opengl", "--metres-per-unit", "0.5"});
}

TEST_CASE("processes take the inputs and ranges named, and print the work that remains") {
  const TemporaryFolder folder;
  const std::vector<std::string> inputs = three_inputs(folder);
  const std::string work = folder.file("work"), list = folder.file("list.txt");
  write_text(list, inputs[1] + "\r\n\n" + inputs[2] + "\n");
  const ProgramResult begun = program(
      {"--lod-partition", work, "--ranges", "5", "--lod-input", "none", "--on-bad", "drop", inputs[0], "--list", list});
  CAPTURE(begun.err);
  REQUIRE(begun.exit_code == 0);
  CHECK(begun.out.find("3 of 3 inputs are not scanned") != std::string::npos);
  const auto listed = [&] {
    const ProgramResult run = program({"--lod-list", work});
    REQUIRE(run.exit_code == 0);
    return nlohmann::json::parse(run.out);
  };
  nlohmann::json state = listed();
  CHECK(state["gaussians"] == 4700);
  CHECK(state["inputs"][1]["path"] == inputs[1]);
  CHECK(state["ranges"].size() == 5);
  CHECK(state["planned"] == false);
  CHECK(program({"--lod-partition", work, "--lod-input", "1-2"}).out.find("scanned 2 of 3 inputs") == 0);
  state = listed();
  CHECK(state["inputs"][0]["scanned"] == false);
  CHECK(state["inputs"][2]["scanned"] == true);
  CHECK(program({"--lod-build", work}).exit_code == 3);  // there is no plan
  REQUIRE(program({"--lod-partition", work, "--lod-input", "0"}).exit_code == 0);
  CHECK(listed()["planned"] == false);
  const ProgramResult planned = program({"--lod-partition", work, "--lod-input", "none"});
  CHECK(planned.exit_code == 0);
  CHECK(planned.out.find("4 of 5 ranges are empty: the scene has 1 stretch") != std::string::npos);
  CHECK(listed()["planned"] == true);
  const ProgramResult placed = program({"--lod-partition", work, "--lod-input", "0-1"});
  CHECK(placed.out.find("scanned 0 of 3 inputs, 2 done before\nplaced 2 of 3 inputs") == 0);
  const ProgramResult missing = program({"--lod-build", work, "--lod-input", "4"});
  CHECK(missing.exit_code == 3);
  CHECK(missing.err.find("rows.2") != std::string::npos);
  REQUIRE(program({"--lod-partition", work}).exit_code == 0);
  state = listed();
  CHECK(state["inputs"][2]["placed"] == true);
  // One stretch: only one range has work.
  std::size_t n_stretches = 0;
  for (const auto& range : state["ranges"]) {
    n_stretches += range["stretches"].get<std::size_t>();
    CHECK(range["built"] == (range["stretches"] == 0));
  }
  CHECK(n_stretches == 1);
  CHECK(program({"--lod-assemble", work, folder.file("early.rgs")}).exit_code == 3);
  REQUIRE(program({"--lod-build", work, "--lod-input", "0-4", "--threads", "1"}).exit_code == 0);
  state = listed();
  for (const auto& range : state["ranges"]) CHECK(range["built"] == true);
  const std::string out = folder.file("out.rgs");
  const ProgramResult json = program({"--lod-assemble", work, out, "--json"});
  REQUIRE(json.exit_code == 0);
  CHECK(nlohmann::json::parse(json.out)["output"]["format"] == "rgs");
  CHECK(program({"--lod-assemble", work, out}).exit_code == 3);  // exists already
  CHECK(program({"--quiet", "--lod-assemble", work, out, "--overwrite"}).out.empty());
  const Bytes input = read_bytes(inputs[0]);
  for (const std::string& taken : {inputs[0], work + "/plan", work + "/job", work + "/scan.1", work + "/rows.2"})
    CHECK(program({"--lod-assemble", work, taken, "--overwrite"}).exit_code == 2);
  CHECK(read_bytes(inputs[0]) == input);
  CHECK_FALSE(std::filesystem::exists(folder.file("early.rgs")));
}

TEST_CASE("options that parts cannot honour are refused before anything is written") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("a.ply"), ordinary_cloud(300, 0, 1)), work = folder.file("work"),
                    rgs = folder.file("a.rgs");
  REQUIRE(rgs_convert({ply, rgs}).exit_code == 0);
  const std::vector<std::string> begin{"--lod-partition", work, "--ranges", "2"};
  for (const std::vector<std::string>& more : {std::vector<std::string>{"--keep-order", ply},
                                               {"--crop", "0,0,0,1,1,1", ply},
                                               {"--max-count", "10", ply},
                                               {"--min-opacity", "0.5", ply},
                                               {"--level-of-detail", "0", ply},
                                               {"--audit", ply},
                                               {"-"},
                                               {rgs},
                                               {"--lod-input", "x", ply},
                                               {"--lod-build", work, ply},
                                               {"--memory", "1MiB", ply},
                                               {"--jobs", "2", ply},
                                               {"--shard", "1/2", ply},
                                               {"--report", work + ".jsonl", ply},
                                               {"--keep-going", ply},
                                               {"--no-keep-going", ply},
                                               {"--json", ply},
                                               {"--translate", "0,0,0", "--translate", "1,0,0", ply}}) {
    CAPTURE(more);
    const ProgramResult run = program(joined(begin, more));
    CAPTURE(run.err);
    CHECK(run.exit_code == 2);
  }
  CHECK_FALSE(std::filesystem::exists(work));
  CHECK(program({"--lod-partition", work, ply}).exit_code == 2);  // without --ranges
  CHECK(program({"--ranges", "2", ply, rgs}).exit_code == 2);
  CHECK(program({"--lod-input", "2", ply, rgs}).exit_code == 2);
  CHECK(program({}).exit_code == 2);
  for (const char* mode : {"--lod-partition", "--lod-build", "--lod-list"}) CHECK(program({mode, work}).exit_code == 3);
  CHECK(program(joined(begin, {folder.file("missing.ply")})).exit_code == 3);
  CHECK(program(joined(begin, {ply, "--lod-input", "7"})).exit_code == 2);  // begun, but there is no input 7
  REQUIRE(program(joined(begin, {ply})).exit_code == 0);
  CHECK(program({"--lod-build", work, "--profile", "direct"}).exit_code == 2);
  CHECK(program({"--lod-build", work, ply}).exit_code == 2);
  CHECK(program({"--lod-partition", work, "--overwrite"}).exit_code == 2);
  CHECK(program({"--lod-build", work, "--lod-input", "2"}).exit_code == 2);
  CHECK(program({"--lod-assemble", work}).exit_code == 2);
  for (const std::vector<std::string>& more : {std::vector<std::string>{"--lod-partition", work, "--shard", "1/2"},
                                               {"--lod-build", work, "--list", ply},
                                               {"--lod-build", work, "--jobs", "2"},
                                               {"--lod-build", work, "--json"},
                                               {"--lod-build", work, "--overwrite"},
                                               {"--lod-assemble", work, folder.file("no.rgs"), "--list", ply},
                                               {"--lod-assemble", work, folder.file("no.rgs"), "--report", "-"},
                                               {"--lod-assemble", work, folder.file("no.rgs"), "--lod-input", "0"},
                                               {"--lod-list", work, "--overwrite"},
                                               {"--lod-list", work, "--lod-input", "0"}}) {
    CAPTURE(more);
    const ProgramResult run = program(more);
    CHECK(run.exit_code == 2);
    CHECK(run.err.find(" has no effect on " + more[0]) != std::string::npos);
  }
  const std::string taken = write_scene(work + "/plan", ordinary_cloud(300, 0, 1));
  const Bytes kept = read_bytes(taken);
  const ProgramResult input = program(joined(begin, {taken, "--overwrite"}));
  CHECK(input.exit_code == 2);
  CHECK(input.err.find("name another folder") != std::string::npos);
  CHECK(read_bytes(taken) == kept);
  const ProgramResult other = program({"--lod-partition", work, "--ranges", "3", ply});
  CHECK(other.exit_code == 3);
  CHECK(other.err.find("other inputs or options") != std::string::npos);
  CHECK(program({"--lod-partition", work, "--ranges", "3", "--overwrite", ply}).exit_code == 0);
}
