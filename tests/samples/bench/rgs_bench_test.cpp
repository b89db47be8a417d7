// rgs_bench_test.cpp - rgs-bench as a user runs it: refusals and exit codes; with a device, a small measurement.
// SPDX-License-Identifier: Apache-2.0
#include <cuda_runtime_api.h>
#include <doctest/doctest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "checkout.hpp"
#include "run_program.hpp"
#include "skip.hpp"
#include "temporary_folder.hpp"
#include "text_file.hpp"

namespace {

using rgs::test::built;
using rgs::test::ProgramResult;
using rgs::test::read_text;
using rgs::test::run_program;
using rgs::test::source_dir;
using rgs::test::TemporaryFolder;

const std::string kScene = source_dir() + "/tests/golden/degree3.rgs";
const std::string kLevels = source_dir() + "/tests/golden/levels_packed.rgs";  // 300 Gaussians, 3 levels in 8 pages

struct Stage {
  TemporaryFolder folder;
  std::string cameras = folder.file("cameras.json");
  Stage() {
    std::ofstream(cameras) << R"([{"name":"a.jpg","split":"test","width":64,"height":48,"fx":60,"fy":60,)"
                              R"("world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,8],[0,0,0,1]]}])";
  }
  ProgramResult run(const std::vector<std::string>& more, const std::string& scene = kScene,
                    const std::function<void()>& before_exec = {}) const {
    std::vector<std::string> arguments{built("rgs-bench"), scene, "--cameras", cameras};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_program(arguments, before_exec);
  }
};

}  // namespace

TEST_CASE("rgs-bench refuses wrong arguments with exit code 2") {
  const Stage stage;
  CHECK(run_program({built("rgs-bench")}).exit_code == 2);
  CHECK(stage.run({"--pixel-format", "rgb8"}).exit_code == 2);
  CHECK(stage.run({"--mode", "fastest"}).exit_code == 2);
  CHECK(stage.run({"--graph"}).exit_code == 2);
  CHECK(stage.run({"--frames", "0"}).exit_code == 2);
  CHECK(stage.run({"--detail", "-1"}).exit_code == 2);
  CHECK(stage.run({"--size", "1920"}).exit_code == 2);
  CHECK(stage.run({"--orbit", "2"}).exit_code == 2);   // no second difference
  CHECK(stage.run({"--photos", "."}).exit_code == 2);  // without cameras
  CHECK(stage.run({"--views", "all"}).exit_code == 2);
  for (const std::vector<std::string>& more : std::vector<std::vector<std::string>>{
           {"--size", "64x48"}, {"--ablate"}, {"--orbit", "5"}, {"--quality-cameras", stage.cameras}, {"--roofline"}}) {
    CAPTURE(more.front());
    std::vector<std::string> arguments{"--views", "stress"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const ProgramResult refused = stage.run(arguments);
    CHECK(refused.exit_code == 2);
    CHECK(refused.err.find("--views stress takes no " + more.front()) != std::string::npos);
  }
  const ProgramResult blind = run_program({built("rgs-bench"), kScene});
  CHECK(blind.exit_code == 2);
  CHECK(blind.err.find("--cameras is required") != std::string::npos);
  CHECK(run_program({built("rgs-bench"), "--help"}).exit_code == 0);
}

TEST_CASE("rgs-bench keeps existing outputs, and checks them before it measures") {
  const Stage stage;
  const std::string output = stage.folder.file("bench.json");
  std::ofstream(output) << "mine";
  const ProgramResult result = stage.run({"--json", output});
  CHECK(result.exit_code == 3);
  CHECK(result.err.find("bench.json") != std::string::npos);
  CHECK(result.out.empty());
  CHECK(read_text(output) == "mine");
  CHECK(stage.run({"--csv", stage.folder.file("no/such/folder.csv")}).exit_code == 3);
}

TEST_CASE("rgs-bench refuses the baseline for levels of detail, but not for their leaves") {
  const Stage stage;
  const auto blind = [] { ::setenv("CUDA_VISIBLE_DEVICES", "", 1); };
  for (const std::vector<std::string>& more :
       std::vector<std::vector<std::string>>{{"--mode", "baseline,turbo"}, {"--ablate"}}) {
    const ProgramResult refused = stage.run(more, kLevels, blind);
    CHECK(refused.exit_code == 2);
    CHECK(refused.err.find("--detail 0") != std::string::npos);
    std::vector<std::string> leaves = more;
    leaves.insert(leaves.end(), {"--detail", "0"});
    CHECK(stage.run(leaves, kLevels, blind).exit_code == 3);  // no device
    CHECK(stage.run(more, kScene, blind).exit_code == 3);
  }
}

TEST_CASE("rgs-bench draws files with levels of detail, and reports the pages of each camera's picture") {
  int n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0) return rgs::test::skip("no CUDA device answers");
  const Stage stage;
  const std::string json = stage.folder.file("levels.json"), leaves_json = stage.folder.file("leaves.json");
  const ProgramResult result = stage.run(
      {"--quality-cameras", stage.cameras, "--size", "64x48", "--frames", "2", "--detail", "1e4", "--json", json},
      kLevels);
  REQUIRE_MESSAGE(result.exit_code == 0, result.err);
  const auto report = nlohmann::json::parse(read_text(json));
  CHECK(report["scene"]["gaussians"] == 300);
  CHECK(report["scene"]["levels"]["levels"] == 3);
  CHECK(report["scene"]["levels"]["pages"] == 8);
  CHECK(report["detail_px"] == 1e4);
  REQUIRE(report["modes"].size() == 2);
  CHECK(report["modes"][0]["name"] == "paper");
  for (const auto& row : report["sizes"][0]["results"]) {
    REQUIRE(row["drawn"].size() == 1);
    CHECK(row["drawn"][0]["camera"] == "a.jpg");
    CHECK(row["drawn"][0]["pages"] == 1);  // the root
    CHECK(row["drawn"][0]["gaussians"].get<int>() < 100);
    CHECK(row["gaussians"] == row["drawn"][0]["gaussians"]);
  }
  CHECK(result.out.find("drawn at detail 10000") != std::string::npos);
  const ProgramResult leaves =
      stage.run({"--size", "64x48", "--frames", "2", "--detail", "0", "--json", leaves_json}, kLevels);
  REQUIRE_MESSAGE(leaves.exit_code == 0, leaves.err);
  const auto all = nlohmann::json::parse(read_text(leaves_json));
  REQUIRE(all["modes"].size() == 3);
  CHECK(all["modes"][0]["name"] == "baseline");
  for (const auto& row : all["sizes"][0]["results"]) {
    CHECK(row["gaussians"] == 300);
    CHECK_FALSE(row.contains("drawn"));
  }
}

TEST_CASE("without a device rgs-bench reports it and writes nothing") {
  const Stage stage;
  const std::string json = stage.folder.file("b.json");
  const ProgramResult result = stage.run({"--json", json}, kScene, [] { ::setenv("CUDA_VISIBLE_DEVICES", "", 1); });
  CHECK(result.exit_code == 3);  // as its --help states
  const auto blind = [] { ::setenv("CUDA_VISIBLE_DEVICES", "", 1); };
  CHECK(run_program({built("rgs-bench"), kScene, "--views", "stress"}, blind).exit_code == 3);  // even without cameras
  CHECK(result.err.find("no CUDA device answers") != std::string::npos);
  CHECK_FALSE(std::filesystem::exists(json));
}

TEST_CASE("rgs-bench measures every mode") {
  // Does not rely on the program: if it failed to find the device, the test would be skipped.
  int n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0) return rgs::test::skip("no CUDA device answers");
  const Stage stage;
  const std::string json = stage.folder.file("b.json"), csv = stage.folder.file("b.csv"),
                    svg = stage.folder.file("b.svg");
  const ProgramResult result = stage.run({"--quality-cameras", stage.cameras, "--size", "64x48,33x17", "--frames", "2",
                                          "--roofline", "--orbit", "5", "--json", json, "--csv", csv, "--svg", svg});
  REQUIRE_MESSAGE(result.exit_code == 0, result.err);
  const auto report = nlohmann::json::parse(read_text(json));
  CHECK(report["scene"]["gaussians"] == 40);
  REQUIRE(report["sizes"].size() == 2);
  REQUIRE(report["sizes"][1]["results"].size() == report["modes"].size());
  for (const auto& row : report["sizes"][0]["results"]) {
    const double inside = row["total_ms"].get<double>(), events = row["eager_events_ms"].get<double>();
    CHECK(inside > 0);
    CHECK(events > 0.5 * inside);  // two frames support no more
    CHECK(row["eager_clock_ms"].get<double>() > events);
    CHECK(row["queued_ms"].get<double>() > 0);
    CHECK(row["host_us"].get<double>() > 0);
  }
  CHECK(report["modes"][0]["quality"]["largest_difference"] == 0);
  CHECK(report["rates"]["copy_bytes"].get<double>() > 0);
  CHECK(report["orbit"]["width"] == 64);
  CHECK(report["orbit"]["results"].size() == 3);
  CHECK(report["orbit"]["results"][0]["unsteadiness"] == 1.0);
  CHECK(read_text(csv).find("\"turbo\"") != std::string::npos);
  CHECK(read_text(svg).find("</svg>") != std::string::npos);
  const std::string packed = stage.folder.file("packed.json");
  const ProgramResult other =
      stage.run({"--mode", "paper", "--size", "64x48", "--frames", "2", "--pixel-format", "rgba8", "--json", packed});
  REQUIRE_MESSAGE(other.exit_code == 0, other.err);
  const auto packed_report = nlohmann::json::parse(read_text(packed));
  CHECK(packed_report["modes"][1]["options"]["pixel_format"] == "rgba8");
  CHECK(packed_report["sizes"][0]["results"][1]["total_ms"].get<double>() > 0);
  CHECK(stage.run({}, stage.cameras).exit_code == 4);  // no scene
}

TEST_CASE("rgs-bench runs the stress views, and fails if turbo is slower") {
  int n_devices = 0;
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0) return rgs::test::skip("no CUDA device answers");
  const Stage stage;
  const std::string json = stage.folder.file("stress.json");
  const ProgramResult result =
      run_program({built("rgs-bench"), kScene, "--views", "stress", "--frames", "5", "--json", json});
  // 40 Gaussians: either may be faster, but the exit code must agree with the report.
  const auto report = nlohmann::json::parse(read_text(json));
  CHECK(report["cameras"] == 1);
  REQUIRE(report["modes"].size() == 2);
  REQUIRE(report["stress"]["views"].size() == 20);
  CHECK_MESSAGE(result.exit_code == (report["stress"]["passed"].get<bool>() ? 0 : 5), result.err);
  CHECK((result.err.find("turbo is slower than paper") == std::string::npos) == (result.exit_code == 0));
  for (const auto& view : report["stress"]["views"]) {
    CHECK(view["paper_ms"].get<double>() > 0);
    CHECK(view["turbo_ms"].get<double>() > 0);
  }
  for (const auto& size : report["sizes"]) {
    if (size["view"] != "empty") continue;
    for (const auto& row : size["results"]) CHECK(row["visible"] == 0);
  }
}
